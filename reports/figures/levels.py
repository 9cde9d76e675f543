"""Error and time against level, as in the paper: a column per test, error rows, a time row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.tables import Tables, level_titles, row_names
from reports.theme import LIMITED, NO_POSE, Style, number, seconds, words
from workflows.metrics import METRICS
from workflows.outcomes import attempted, comparable_times

ERRORS = {name: metric.axis for name, metric in METRICS.items() if metric.axis}  # column -> title
BAND = (0.1, 0.9)
FLOOR = "fit to the true pairs"
MIN_ERROR = (
    1e-3  # smaller errors are drawn here, so that a logarithmic axis shows relevant differences
)
MOST_TICKS = 8
_COLUMNS = ["run_id", "instance_id", "dataset", "method", "test", "level", "outcome"]
_COLUMNS += ["time_solve_s", "rmse_floor"]


def build(tables: Tables, styles: dict[str, Style], model: str) -> Figure:
    """Draw all runs of one transformation model."""
    title = f"Error and time against level, {model}"
    return assemble(f"levels-{model}", title, prepare(tables, model), styles)


def assemble(
    identity: str,
    title: str,
    runs: pd.DataFrame,
    styles: dict[str, Style],
    scale: str = "log",
    x_titles: dict[str, str] | None = None,
) -> Figure:
    """Draw these runs: a column per test, a row per shape and one for the time."""
    x_titles = x_titles or level_titles(runs)
    errors = available_errors(runs)
    rows = list(runs["row"].unique())
    floors = _floors(runs)
    times = _curves(runs.assign(row=""), "time_solve_s")
    views = {}
    for error in errors:
        grid, cells = _axes(runs, rows, ERRORS[error], scale, x_titles)
        curves = {**_curves(runs, error), **times}
        traces = []
        for cell, axes in cells.items():
            for method, style in styles.items():
                if (curve := curves.get((*cell, method))) is not None:
                    traces += _curve_traces(curve, axes, style)
            if error == "rmse" and cell[1]:  # last, so that no curve hides the floor
                traces += _floor_trace(floors.get(cell), axes)
        views[error] = {"data": traces, "layouts": grid.layouts()}
    grid, _ = _axes(runs, rows, ERRORS["rmse"], scale, x_titles)
    payload = {
        "views": views,
        "scales": {
            "error": grid.axes("y", set(range(len(rows)))),
            "time": grid.axes("y", {len(rows)}),
        },
    }
    return Figure(identity, title, "plain", payload, grid)


def prepare(tables: Tables, model: str) -> pd.DataFrame:
    """Return the attempted runs of `model` with their figure row."""
    columns = [*_COLUMNS, "shape", *(name for name in ERRORS if name in tables.runs)]
    runs = tables.runs.assign(time_solve_s=comparable_times(tables.runs))
    runs = runs.loc[runs["model"] == model, columns]
    return attempted(runs.assign(row=row_names(runs))).drop(columns="shape")


def available_errors(runs: pd.DataFrame) -> list[str]:
    """Return the error columns that add information to the RMSE."""
    found = [name for name in ERRORS if name in runs and runs[name].notna().any()]
    same = "rmse_over_scale" in found and np.allclose(
        runs["rmse"], runs["rmse_over_scale"], equal_nan=True
    )
    flat = "scale_error" in found and (runs["scale_error"].dropna().abs() < 1e-9).all()
    hidden = {name for name, drop in (("rmse_over_scale", same), ("scale_error", flat)) if drop}
    return [name for name in found if name not in hidden]


def _axes(
    runs: pd.DataFrame, rows: list[str], error_title: str, scale: str, x_titles: dict[str, str]
) -> tuple[Grid, dict[tuple[str, str], tuple[str, str]]]:
    """Return panels for every (test, row) with data; the row named "" is the time."""
    present = set(zip(runs["test"], runs["row"], strict=True))
    tests = list(runs["test"].unique())
    grid, cells = Grid(column_titles=[words(test) for test in tests]), {}
    for column, test in enumerate(tests):
        levels = sorted(runs.loc[runs["test"] == test, "level"].unique())
        for index, row in enumerate([*rows, ""]):
            if row and (test, row) not in present:
                continue
            panel = Panel(
                row=index,
                column=column,
                x_title=x_titles[test],
                y_title=f"{row}<br>{error_title}" if row else "time (s)",
                y_type=scale if row else "log",
                y_from_zero=bool(row),
                x_ticks=levels if len(levels) <= MOST_TICKS else [],
            )
            cells[(test, row)] = grid.add(panel)
    return grid, cells


def _floors(runs: pd.DataFrame) -> dict[tuple[str, str], pd.Series]:
    """Return the median floor of each level, by test and row."""
    once = runs.drop_duplicates(["test", "row", "instance_id"])
    found = once.groupby(["test", "row", "level"])["rmse_floor"].median().dropna()
    return {
        (str(test), str(row)): part.droplevel(["test", "row"])
        for (test, row), part in found.groupby(["test", "row"])
    }


def _floor_trace(floor: pd.Series | None, axes: tuple[str, str]) -> list[dict[str, Any]]:
    if floor is None:
        return []
    marker = {"symbol": "line-ew-open", "size": 22, "line": {"width": 1.5}}
    look = {"mode": "lines"} if len(floor) > 1 else {"mode": "markers", "marker": marker}
    return [
        {
            "x": list(floor.index), "y": list(floor), "xaxis": axes[0], "yaxis": axes[1],
            **look, "line": {"dash": "dash", "width": 1.5}, "name": FLOOR,
            "hovertemplate": f"{FLOOR}<br>level %{{x}}: %{{y:.4g}}<extra></extra>",
            "meta": {"role": "floor"},
        }
    ]  # fmt: skip


@dataclass(frozen=True)
class _Curve:
    """One quantity of a method against the level."""

    column: str
    points: list[dict[str, Any]]  # a row of `statistics` per level

    def values(self, name: str) -> list[float]:
        return [point[name] for point in self.points]


def _curves(runs: pd.DataFrame, column: str) -> dict[tuple[str, str, str], _Curve]:
    """Return the curves of a column, by test, row and method."""
    points: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for point in statistics(runs, column):
        points.setdefault((point["test"], point["row"], point["method"]), []).append(point)
    return {key: _Curve(column, each) for key, each in points.items()}


def statistics(runs: pd.DataFrame, column: str) -> list[dict[str, Any]]:
    """Return a row per test, row, method and level with a value, sorted by level.

    ``low`` to ``mean`` are of the drawn values, ``shown_…`` of the values themselves: errors are drawn
    from `MIN_ERROR`.
    """
    import polars as pl

    keys = ["test", "row", "method", "level"]
    table = pl.from_pandas(runs[[*keys, "run_id", "outcome", column]]).lazy()
    value = pl.col(column)
    drawn = value if column == "time_solve_s" else value.clip(lower_bound=MIN_ERROR)
    ordered = (
        pl.col("run_id")
        .filter(value.is_not_null())
        .sort_by(value.drop_nulls(), maintain_order=True)
    )
    found = table.group_by(keys).agg(
        planned=pl.len(),
        failed=(pl.col("outcome") == "failed").sum(),
        any_limited=(pl.col("outcome") == "limited").sum(),
        limited=((pl.col("outcome") == "limited") & value.is_not_null()).sum(),
        count=value.count(),
        low=drawn.quantile(BAND[0], "linear"),
        median=drawn.median(),
        high=drawn.quantile(BAND[1], "linear"),
        mean=drawn.mean(),
        shown_low=value.quantile(BAND[0], "linear"),
        shown_median=value.quantile(0.5, "linear"),
        shown_high=value.quantile(BAND[1], "linear"),
        shown_mean=value.mean(),
        worst=value.max(),
        median_run=ordered.get((value.count() - 1) // 2, null_on_oob=True),
        worst_run=ordered.last(),
    )
    return (
        found.filter(pl.col("count") > 0)
        .sort("level", "test", "row", "method")
        .collect()
        .to_dicts()
    )


def _curve_traces(curve: _Curve, axes: tuple[str, str], style: Style) -> list[dict[str, Any]]:
    levels, low, high = (curve.values(name) for name in ("level", "low", "high"))
    base = {"xaxis": axes[0], "yaxis": axes[1], "name": style.name}
    line = {
        **base, "x": levels, "mode": "lines+markers",
        "text": [_hover(point, curve.column, style) for point in curve.points],
        "hovertemplate": "%{text}<extra></extra>",
    }  # fmt: skip
    symbols = [style.symbol + _ending(point) for point in curve.points]
    return [
        {
            **base, "x": levels + levels[::-1], "y": [*high, *low[::-1]], "mode": "lines",
            "fill": "toself", "line": {"width": 0}, "hoverinfo": "skip",
            "meta": {"role": "band", "method": style.label},
        },
        {
            **line, "y": curve.values("median"), "line": {"width": 2, "dash": style.dash},
            "marker": {"size": 7, "symbol": symbols},
            "meta": {"role": "median", "method": style.label},
        },
        {
            **line, "y": curve.values("mean"), "line": {"width": 1.5, "dash": style.dash},
            "marker": {"size": 7, "symbol": symbols},
            "meta": {"role": "mean", "method": style.label},
        },
    ]  # fmt: skip


def _ending(point: Mapping[str, Any]) -> str:
    """Return the ending of the symbol that marks runs that did not finish."""
    return NO_POSE if point["failed"] else LIMITED if point["any_limited"] else ""


def _hover(point: Mapping[str, Any], column: str, style: Style) -> str:
    shown = seconds if column == "time_solve_s" else number
    limited, failed = point["limited"], point["failed"]
    return "<br>".join(
        [
            f"<b>{style.name}</b>, level {point['level']:g}, n = {point['planned']}"
            + (f" ({limited} at a limit)" if limited else "")
            + (f" ({failed} without a pose)" if failed else ""),
            f"median {shown(point['shown_median'])}, mean {shown(point['shown_mean'])}",
            f"10–90 %: {shown(point['shown_low'])} … {shown(point['shown_high'])}",
            f"median run {point['median_run']}",
            f"worst run {point['worst_run']} ({shown(point['worst'])})",
        ]
    )
