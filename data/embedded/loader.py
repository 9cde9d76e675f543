"""Shapes that need no file: two contours and two solids, drawn by our own code."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from data.contract import PrototypeDataset
from data.embedded.contours import FISH, GLYPH, sample_strokes
from data.embedded.solids import PONY, SAURIAN, sample_solid

DEFAULT_POINTS = 100


@cache
def _points(shape: str, n_points: int) -> np.ndarray:
    if shape in ("fish", "glyph"):
        return sample_strokes({"fish": FISH, "glyph": GLYPH}[shape], n_points)
    return sample_solid({"pony": PONY, "saurian": SAURIAN}[shape], n_points)


class Loader(PrototypeDataset):
    """``fish`` and ``glyph`` (2D), ``pony`` and ``saurian`` (3D); any number of points."""

    def shapes(self) -> list[str]:
        return ["fish", "glyph", "pony", "saurian"]

    def fetch(self, shape: str, test: str = "", level: float = 0.0, trial: int = 0) -> list[Path]:
        return []

    def points(self, shape: str, n_points: int | None = None) -> np.ndarray:
        return _points(shape, n_points or DEFAULT_POINTS).copy()
