"""Panels with a source (red circles) and a target (blue crosses), as in the paper."""

from __future__ import annotations

from typing import Any

import numpy as np

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel

DRAWN = ("source", "target")
_OBLIQUE = np.array([[0.866, -0.5, 0.0], [0.3, 0.52, 0.8]])  # the page's view of 3D clouds


def assemble(
    identity: str,
    title: str,
    columns: list[str],
    panels: list[tuple[int, int, str, np.ndarray, np.ndarray]],
) -> Figure:
    """Return a figure of panels, each with row, column, name of the row, source and target."""
    grid, traces = Grid(column_titles=columns), []
    for row, column, name, source, target in panels:
        axes = grid.add(
            Panel(row, column, "", name, share_x=False, share_y=False, equal=True, hidden=True)
        )
        traces += [_points("source", source, axes), _points("target", target, axes)]
    payload = {"views": {"": {"data": traces, "layouts": grid.layouts()}}, "scales": {}}
    return Figure(identity, title, "plain", payload, grid)


def _points(role: str, points: np.ndarray, axes: tuple[str, str]) -> dict[str, Any]:
    flat = points @ _OBLIQUE.T if points.shape[1] == 3 else points
    return {
        "x": flat[:, 0].round(4), "y": flat[:, 1].round(4), "xaxis": axes[0], "yaxis": axes[1],
        "mode": "markers", "name": role, "hoverinfo": "name",
        "marker": {"symbol": "circle-open" if role == "source" else "cross-thin-open", "size": 5},
        "meta": {"role": role},
    }  # fmt: skip
