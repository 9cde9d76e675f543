"""Profiles per method over the attempted runs: error, time, and time against the fastest method."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.tables import Tables, is_right
from reports.theme import Style
from workflows.outcomes import attempted, main_machine

_ERROR, _TIME, _RATIO = "rmse", "time_solve_s", "ratio"
_PANELS = {
    _ERROR: ("error of all runs", "RMSE", "runs with at most this error"),
    _TIME: ("time, right poses only", "time (s)", "right within this time"),
    _RATIO: (
        "time against the fastest",
        "multiple of the fastest method",
        "right within this multiple",
    ),
}
_MOST_STEPS = 250
_NEEDED = ["model", "method", "outcome", "machine_id", "success", _ERROR, _TIME]


def build(tables: Tables, styles: dict[str, Style], model: str) -> Figure:
    """Draw the share of runs of each method within an error or a time.

    Wrong and missing poses count in the denominator only, so a curve over time ends at the success rate.
    The times are those of one machine.
    """
    runs = attempted(tables.runs[["instance_id", *_NEEDED]])
    runs = runs[runs["model"] == model]
    here = runs["machine_id"] == main_machine(tables.runs)
    times = runs[_TIME].where(is_right(runs) & here)
    rivals = times.where(~runs["method"].map(tables.is_oracle))
    fastest = rivals.groupby(runs["instance_id"]).transform("min")
    runs = runs.assign(**{_TIME: times, _RATIO: times / fastest})
    grid, traces = Grid(column_titles=[title for title, *_ in _PANELS.values()]), []
    for column, (name, (_, title, share)) in enumerate(_PANELS.items()):
        axes = grid.add(Panel(0, column, title, "share of runs", x_type="log", share_x=False))
        for method, style in styles.items():
            part = runs[(runs["method"] == method) & (here | (name == _ERROR))]
            if part[name].notna().any():
                traces.append(_steps(part[name], share, axes, style))
    view = {"data": traces, "layouts": grid.layouts()}
    payload = {"views": {"": view}, "scales": {"x": grid.axes("x", {0})}}
    return Figure(f"profile-{model}", f"Error and time profiles, {model}", "plain", payload)


def _steps(column: pd.Series, share: str, axes: tuple[str, str], style: Style) -> dict[str, Any]:
    values = np.sort(column.dropna().to_numpy())
    shares = np.arange(1, len(values) + 1) / len(column)
    if len(values) > _MOST_STEPS:
        index = np.unique(np.linspace(0, len(values) - 1, _MOST_STEPS).astype(int))
        values, shares = values[index], shares[index]
    return {
        "x": np.maximum(values, 1e-6), "y": shares, "xaxis": axes[0], "yaxis": axes[1],
        "mode": "lines+markers", "name": style.name,
        "marker": {"symbol": style.symbol, "size": 7, "maxdisplayed": 6},
        "line": {"shape": "hv", "width": 2, "dash": style.dash},
        "hovertemplate": f"{style.name}<br>%{{y:.0%}} of {len(column)} runs {share}: %{{x:.3g}}"
        "<extra></extra>",
        "meta": {"role": "profile", "method": style.label},
    }  # fmt: skip
