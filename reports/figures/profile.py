"""Empirical distribution of error and time over the attempted runs, per method."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.tables import Tables
from reports.theme import Style
from workflows.outcomes import attempted, main_machine

_COLUMNS = {"rmse": "RMSE", "time_solve_s": "time (s)"}
_MOST_STEPS = 250


def build(tables: Tables, styles: dict[str, Style], model: str) -> Figure:
    """Draw the distributions; runs without a pose count in the denominator only.

    The times are those of the runs on one machine.
    """
    runs = tables.runs[["model", "method", "outcome", "machine_id", *_COLUMNS]]
    runs = attempted(runs[runs["model"] == model])
    here = runs["machine_id"] == main_machine(tables.runs)
    grid, traces = Grid(column_titles=["error", "time"]), []
    for column, (name, title) in enumerate(_COLUMNS.items()):
        panel = Panel(0, column, title, "share of runs", x_type="log", share_x=False)
        axes = grid.add(panel)
        for method, style in styles.items():
            part = runs[(runs["method"] == method) & (here | (name != "time_solve_s"))]
            if part[name].notna().any():
                traces.append(_steps(part, name, axes, style))
    view = {"data": traces, "layouts": grid.layouts()}
    payload = {"views": {"": view}, "scales": {"x": grid.axes("x", {0})}}
    return Figure(f"profile-{model}", f"Error and time profile, {model}", "plain", payload)


def _steps(part: pd.DataFrame, name: str, axes: tuple[str, str], style: Style) -> dict[str, Any]:
    values = np.sort(part[name].dropna().to_numpy())
    share = np.arange(1, len(values) + 1) / len(part)
    if len(values) > _MOST_STEPS:
        index = np.unique(np.linspace(0, len(values) - 1, _MOST_STEPS).astype(int))
        values, share = values[index], share[index]
    return {
        "x": np.maximum(values, 1e-6), "y": share, "xaxis": axes[0], "yaxis": axes[1],
        "mode": "lines+markers", "name": style.name,
        "marker": {"symbol": style.symbol, "size": 7, "maxdisplayed": 6},
        "line": {"shape": "hv", "width": 2, "dash": style.dash},
        "hovertemplate": f"{style.name}<br>%{{y:.0%}} of {len(part)} runs ≤ %{{x:.3g}}"
        "<extra></extra>",
        "meta": {"role": "profile", "method": style.label},
    }  # fmt: skip
