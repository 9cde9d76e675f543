"""Profiles per method over the attempted runs: error, time, time against the fastest method, and work."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.tables import Tables, is_right, share_intervals
from reports.theme import Style
from workflows.outcomes import attempted, is_timed

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
WORK = {"n_nodes": "nodes", "n_assignments": "assignments"}  # column -> title; a view for each
_MOST_STEPS = 250
_SMALLEST = 1e-6  # error or time on a logarithmic axis; work starts at 1
_NEEDED = ["model", "method", "outcome", "success", _ERROR, _TIME]


def build(tables: Tables, styles: dict[str, Style], model: str) -> Figure:
    """Draw the share of runs of each method within an error, a time or an amount of work.

    Wrong and missing poses count in the denominator only, so a curve over time ends at the success rate.
    The times are those of one machine. There is a view for each measure of work that a method states.
    """
    counted = [name for name in WORK if name in tables.runs]
    runs = attempted(tables.runs[["instance_id", *_NEEDED, *counted]])
    runs = runs[runs["model"] == model]
    right, here = is_right(runs), is_timed(tables.runs)[runs.index]
    times = runs[_TIME].where(right & here)
    rivals = times.where(~runs["method"].map(tables.is_oracle))
    fastest = rivals.groupby(runs["instance_id"]).transform("min")
    work = {name: runs[name].astype(float).where(right).clip(lower=1.0) for name in counted}
    runs = runs.assign(**{_TIME: times, _RATIO: times / fastest, **work})
    # no method is the fastest if each ran on other instances
    panels = {name: of for name, of in _PANELS.items() if name != _RATIO or not tables.is_of_blocks}
    views = {
        title: _view(
            runs, here, styles, {**panels, name: ("work, right poses only", title, _within(title))}
        )
        for name, title in WORK.items()
        if name in runs and runs[name].notna().any()
    }
    views = views or {"": _view(runs, here, styles, panels)}
    layout = next(iter(views.values()))["layouts"]["wide"]
    payload = {
        "views": views,
        "scales": {"x": [name for name in layout if name.startswith("xaxis")]},
    }
    return Figure(f"profile-{model}", f"Error, time and work profiles, {model}", "plain", payload)


def _within(title: str) -> str:
    return f"right within this number of {title}"


def _view(
    runs: pd.DataFrame,
    here: pd.Series,
    styles: dict[str, Style],
    panels: dict[str, tuple[str, str, str]],
) -> dict[str, Any]:
    """Return the panels; `here` marks the runs of the machine of all times."""
    grid, traces = Grid(column_titles=[title for title, *_ in panels.values()]), []
    for column, (name, (_, title, share)) in enumerate(panels.items()):
        axes = grid.add(Panel(0, column, title, "share of runs", x_type="log", share_x=False))
        for method, style in styles.items():
            is_timed = name in (_TIME, _RATIO)
            part = runs[(runs["method"] == method) & (here | (not is_timed))]
            if part[name].notna().any():
                traces += _steps(part[name], share, axes, style)
    return {"data": traces, "layouts": grid.layouts()}


def _steps(
    column: pd.Series, share: str, axes: tuple[str, str], style: Style
) -> list[dict[str, Any]]:
    """Return the band of pointwise intervals and the curve."""
    values = np.sort(column.dropna().to_numpy())
    shown = np.unique(np.linspace(0, len(values) - 1, min(len(values), _MOST_STEPS)).astype(int))
    values, counts = np.maximum(values[shown], _SMALLEST), shown + 1
    base = {"xaxis": axes[0], "yaxis": axes[1], "name": style.name}
    x = np.repeat(values, 2)[1:]  # corners of the steps
    low, high = (np.repeat(each, 2)[:-1] for each in share_intervals(counts, len(column)))
    return [
        {
            **base, "x": np.concatenate([x, x[::-1]]), "y": np.concatenate([high, low[::-1]]),
            "mode": "lines", "fill": "toself", "line": {"width": 0}, "hoverinfo": "skip",
            "meta": {"role": "band", "method": style.label},
        },
        {
            **base, "x": values, "y": counts / len(column), "mode": "lines+markers",
            "marker": {"symbol": style.symbol, "size": 7, "maxdisplayed": 6},
            "line": {"shape": "hv", "width": 2, "dash": style.dash},
            "hovertemplate": f"{style.name}<br>%{{y:.0%}} of {len(column)} runs {share}: %{{x:.3g}}"
            "<extra></extra>",
            "meta": {"role": "profile", "method": style.label},
        },
    ]  # fmt: skip
