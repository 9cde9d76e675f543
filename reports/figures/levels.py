"""Error and time against level, as in the paper: a column per test, error rows, a time row."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.figures.printing import LIMITED, NO_POSE
from reports.tables import Tables, level_titles, row_names
from reports.theme import Style, number, seconds, words
from workflows.metrics import METRICS
from workflows.outcomes import attempted

ERRORS = {name: metric.axis for name, metric in METRICS.items() if metric.axis}  # column -> title
BAND = (0.1, 0.9)
FLOOR = "fit to the true pairs"
MIN_ERROR = (
    1e-3  # smaller errors are drawn here, so that a logarithmic axis shows relevant differences
)
MOST_TICKS = 8
_COLUMNS = ["run_id", "instance_id", "dataset", "method", "test", "level", "outcome", "row"]
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
    rows = list(dict.fromkeys(runs["row"]))
    views = {}
    for error in errors:
        grid, cells = _axes(runs, rows, ERRORS[error], scale, x_titles)
        traces = []
        for (test, row), axes in cells.items():
            cell = runs[(runs["test"] == test) & ((row == "") | (runs["row"] == row))]
            column = error if row else "time_solve_s"
            traces += _cell_traces(cell, column, axes, styles)
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
    runs = tables.runs[tables.runs["model"] == model]
    runs = attempted(runs.assign(row=row_names(runs)))
    return runs[[*_COLUMNS, *(name for name in ERRORS if name in runs)]]


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
    tests = list(dict.fromkeys(runs["test"]))
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


def _cell_traces(
    cell: pd.DataFrame, column: str, axes: tuple[str, str], styles: dict[str, Style]
) -> list[dict[str, Any]]:
    traces = []
    for method, style in styles.items():
        part = cell[cell["method"] == method]
        if part[column].notna().any():
            traces += _method_traces(part, column, axes, style)
    if column == "rmse":  # last, so that no curve hides the floor
        traces += _floor(cell, axes)
    return traces


def _floor(cell: pd.DataFrame, axes: tuple[str, str]) -> list[dict[str, Any]]:
    floor = cell.drop_duplicates("instance_id").groupby("level")["rmse_floor"].median().dropna()
    if floor.empty:
        return []
    return [
        {
            "x": list(floor.index), "y": list(floor), "xaxis": axes[0], "yaxis": axes[1],
            "mode": "lines", "line": {"dash": "dash", "width": 1.5}, "name": FLOOR,
            "hovertemplate": f"{FLOOR}<br>level %{{x}}: %{{y:.4g}}<extra></extra>",
            "meta": {"role": "floor"},
        }
    ]  # fmt: skip


def _method_traces(
    part: pd.DataFrame, column: str, axes: tuple[str, str], style: Style
) -> list[dict[str, Any]]:
    posed = part[part[column].notna()]
    if column != "time_solve_s":
        posed = posed.assign(**{column: posed[column].clip(lower=MIN_ERROR)})
    groups = posed.groupby("level")[column]
    low, high = groups.quantile(BAND[0]), groups.quantile(BAND[1])
    median, mean = groups.median(), groups.mean()
    levels = [float(level) for level in median.index]
    by_level = dict(list(part.groupby("level")))
    hover = [_hover(by_level[level], column, style) for level in levels]
    base = {"xaxis": axes[0], "yaxis": axes[1], "name": style.name}
    line = {
        **base, "x": levels, "mode": "lines+markers", "text": hover,
        "hovertemplate": "%{text}<extra></extra>",
    }  # fmt: skip
    symbols = [style.symbol + _ending(by_level[level]) for level in levels]
    return [
        {
            **base, "x": levels + levels[::-1], "y": [*high, *low[::-1]], "mode": "lines",
            "fill": "toself", "line": {"width": 0}, "hoverinfo": "skip",
            "meta": {"role": "band", "method": style.label},
        },
        {
            **line, "y": list(median), "line": {"width": 2, "dash": style.dash},
            "marker": {"size": 7, "symbol": symbols},
            "meta": {"role": "median", "method": style.label},
        },
        {
            **line, "y": list(mean), "line": {"width": 1.5, "dash": style.dash},
            "marker": {"size": 7, "symbol": symbols},
            "meta": {"role": "mean", "method": style.label},
        },
    ]  # fmt: skip


def _ending(part: pd.DataFrame) -> str:
    """Return the ending of the symbol that marks runs that did not finish."""
    if part["outcome"].eq("failed").any():
        return NO_POSE
    return LIMITED if part["outcome"].eq("limited").any() else ""


def _hover(part: pd.DataFrame, column: str, style: Style) -> str:
    shown = seconds if column == "time_solve_s" else number
    planned, failed = len(part), int(part["outcome"].eq("failed").sum())
    part = part[part[column].notna()].sort_values(column, kind="stable")
    values, run_ids = part[column].to_numpy(), part["run_id"].to_numpy()
    limited = int(part["outcome"].eq("limited").sum())
    low, median, high = np.quantile(values, (BAND[0], 0.5, BAND[1]))
    return "<br>".join(
        [
            f"<b>{style.name}</b>, level {part['level'].iloc[0]:g}, n = {planned}"
            + (f" ({limited} at a limit)" if limited else "")
            + (f" ({failed} without a pose)" if failed else ""),
            f"median {shown(median)}, mean {shown(values.mean())}",
            f"10–90 %: {shown(low)} … {shown(high)}",
            f"median run {run_ids[(len(part) - 1) // 2]}",
            f"worst run {run_ids[-1]} ({shown(values[-1])})",
        ]
    )
