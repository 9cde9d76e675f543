"""A spiral in 2D."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data.contract import PrototypeDataset


class Loader(PrototypeDataset):
    """One shape, without files."""

    def shapes(self) -> list[str]:
        return ["spiral"]

    def fetch(self, shape: str, test: str = "", level: float = 0.0, trial: int = 0) -> list[Path]:
        return []

    def points(self, shape: str, n_points: int | None = None) -> np.ndarray:
        angle = np.linspace(1.0, 12.0, n_points or 50)
        return np.column_stack([angle * np.cos(angle), angle * np.sin(angle)])
