"""Error and time of two methods, a point per instance; the page chooses the two."""

from __future__ import annotations

from typing import Any

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel

ROW_PX = 320


def build(comparisons: list[dict[str, Any]], start: list[list[str]]) -> Figure:
    """Return the figure; it opens with the methods of `start`, two for each model."""
    grid = Grid(column_titles=["RMSE", "time"], row_px=ROW_PX)
    for column, name in enumerate(("RMSE", "time (s)")):
        grid.add(
            Panel(
                0, column, f"{name} of A", f"{name} of B", "log", "log",
                share_x=False, share_y=False,
            )
        )  # fmt: skip
    payload = {"comparisons": comparisons, "start": start, "layouts": grid.layouts(), "scales": {}}
    return Figure("versus", "Two methods on the same instances", "versus", payload)
