"""An interactive figure, as the page and the printer receive it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reports.figures.grid import Grid


@dataclass(frozen=True)
class Figure:
    """An interactive figure: data for one of the builders in ``assets/report.js``."""

    id: str
    title: str
    builder: str
    payload: dict[str, Any]
    grid: Grid | None = None  # for figures that are also printed
    # Grey photographs behind panels, by the panel's index; printed only.
    photographs: dict[int, np.ndarray] = field(default_factory=dict)

    @property
    def heights(self) -> dict[str, int]:
        """Heights in pixels of the wide and the narrow layout, reserved until the figure is drawn."""
        first = next(iter(self.payload.get("views", {}).values()), self.payload)
        return {name: layout["height"] for name, layout in first["layouts"].items()}

    @property
    def methods(self) -> set[str]:
        """Labels of the methods that any view of the figure draws."""
        drawn = [trace for view in self.payload.get("views", {}).values() for trace in view["data"]]
        return {trace["meta"]["method"] for trace in drawn if "method" in trace["meta"]}

    @property
    def traces(self) -> list[dict[str, Any]]:
        """The traces of the first view, which is printed."""
        return next(iter(self.payload["views"].values()))["data"]
