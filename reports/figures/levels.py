"""Error and time versus level: the paper's figure, a column per test, error rows, a time row."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.figure import Figure as MplFigure

from reports.figures.grid import Grid, Panel
from reports.page import Figure
from reports.tables import Tables, row_names
from reports.theme import Style, number, seconds, words

# column -> (menu text, axis title)
ERRORS = {
    "rmse": ("RMSE", "RMSE"),
    "rmse_over_scale": ("RMSE / scale", "RMSE / scale"),
    "rotation_error_deg": ("rotation error", "rotation (°)"),
    "translation_error": ("translation error", "translation"),
    "scale_error": ("scale error", "scale"),
}
BAND = (0.1, 0.9)
FLOOR = "fit to the true pairs"
_COLUMNS = ["run_id", "instance_id", "method", "test", "level", "outcome", "row"]
_COLUMNS += ["time_solve_s", "rmse_floor"]


def build(tables: Tables, styles: dict[str, Style], model: str) -> Figure:
    """The interactive figure for all runs of one transformation model."""
    runs = prepare(tables, model)
    errors = available_errors(runs)
    tests = list(dict.fromkeys(runs["test"]))
    rows = list(dict.fromkeys(runs["row"]))
    views = {}
    for error in errors:
        grid, cells = _axes(runs, tests, rows, ERRORS[error][1])
        traces = []
        for (test, row), axes in cells.items():
            cell = runs[(runs["test"] == test) & (row == "" or runs["row"] == row)]
            column = error if row else "time_solve_s"
            traces += _cell_traces(cell, column, axes, styles)
        views[error] = {"data": traces, "layouts": grid.layouts()}
    grid, _ = _axes(runs, tests, rows, "")
    payload = {
        "views": views,
        "scales": {
            "error": grid.axes("y", set(range(len(rows)))),
            "time": grid.axes("y", {len(rows)}),
        },
    }
    return Figure(f"levels-{model}", f"Error and time versus level, {model}", "plain", payload)


def prepare(tables: Tables, model: str) -> pd.DataFrame:
    """Runs of `model` with a pose, with their figure row."""
    runs = tables.runs[tables.runs["model"] == model]
    runs = runs.assign(row=row_names(runs))
    kept = [*_COLUMNS, *(name for name in ERRORS if name in runs)]
    return runs.loc[runs["rmse"].notna() | runs["time_solve_s"].notna(), kept]


def available_errors(runs: pd.DataFrame) -> list[str]:
    """Error columns that hold anything beyond what the plain RMSE says already."""
    found = [name for name in ERRORS if name in runs and runs[name].notna().any()]
    same = "rmse_over_scale" in found and np.allclose(
        runs["rmse"], runs["rmse_over_scale"], equal_nan=True
    )
    flat = "scale_error" in found and (runs["scale_error"].dropna().abs() < 1e-9).all()
    hidden = {name for name, drop in (("rmse_over_scale", same), ("scale_error", flat)) if drop}
    return [name for name in found if name not in hidden]


def _axes(
    runs: pd.DataFrame, tests: list[str], rows: list[str], error_title: str
) -> tuple[Grid, dict[tuple[str, str], tuple[str, str]]]:
    """Panels for every (test, row) with data; the row named "" is the time."""
    present = set(zip(runs["test"], runs["row"], strict=True))
    grid, cells = Grid(column_titles=[words(test) for test in tests]), {}
    for column, test in enumerate(tests):
        for index, row in enumerate([*rows, ""]):
            if row and (test, row) not in present:
                continue
            panel = Panel(
                row=index,
                column=column,
                x_title="level",
                y_title=f"{row}<br>{error_title}" if row else "time (s)",
                y_type="linear" if row else "log",
                y_from_zero=bool(row),
            )
            cells[(test, row)] = grid.add(panel)
    return grid, cells


def _cell_traces(
    cell: pd.DataFrame, column: str, axes: tuple[str, str], styles: dict[str, Style]
) -> list[dict[str, Any]]:
    traces = []
    is_error = column != "time_solve_s"
    if is_error and column == "rmse":
        traces += _floor(cell, axes)
    for method, style in styles.items():
        part = cell[(cell["method"] == method) & cell[column].notna()]
        if len(part):
            traces += _method_traces(part, column, axes, style)
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
    groups = part.groupby("level")[column]
    low, high = groups.quantile(BAND[0]), groups.quantile(BAND[1])
    median, mean = groups.median(), groups.mean()
    levels = [float(level) for level in median.index]
    hover = [_hover(cell, column, style) for _, cell in part.groupby("level")]
    limited = part["outcome"].eq("limited").groupby(part["level"]).any()
    base = {"xaxis": axes[0], "yaxis": axes[1], "name": style.name}
    line = {
        **base, "x": levels, "mode": "lines+markers", "text": hover,
        "hovertemplate": "%{text}<extra></extra>",
    }  # fmt: skip
    symbols = [style.symbol + ("-open" if limited[level] else "") for level in median.index]
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
            **line, "y": list(mean), "line": {"width": 1.5, "dash": "dot"},
            "marker": {"size": 5, "symbol": "line-ew-open"},
            "meta": {"role": "mean", "method": style.label},
        },
    ]  # fmt: skip


def _hover(part: pd.DataFrame, column: str, style: Style) -> str:
    shown = seconds if column == "time_solve_s" else number
    part = part.sort_values(column, kind="stable")
    values, run_ids = part[column].to_numpy(), part["run_id"].to_numpy()
    limited = int(part["outcome"].eq("limited").sum())
    low, median, high = np.quantile(values, (BAND[0], 0.5, BAND[1]))
    return "<br>".join(
        [
            f"<b>{style.name}</b>, level {part['level'].iloc[0]:g}, n = {len(part)}"
            + (f" ({limited} at a limit)" if limited else ""),
            f"median {shown(median)}, mean {shown(values.mean())}",
            f"10–90 %: {shown(low)} … {shown(high)}",
            f"median run {run_ids[(len(part) - 1) // 2]}",
            f"worst run {run_ids[-1]} ({shown(values[-1])})",
        ]
    )


def save_static(
    tables: Tables, styles: dict[str, Style], model: str, statistic: str, folder: Path
) -> list[Path]:
    """The same figure in print, as SVG and PDF; `statistic` is "median" or "mean"."""
    folder.mkdir(parents=True, exist_ok=True)
    suffix = "" if statistic == "median" else f"-{statistic}"
    paths = [folder / f"levels-{model}{suffix}.{kind}" for kind in ("svg", "pdf")]
    with sns.axes_style("whitegrid"), matplotlib.rc_context(_PRINT):
        figure = draw_static(tables, styles, model, statistic)
        for path in paths:
            # no creation date: the same tables give the same file
            date = "Date" if path.suffix == ".svg" else "CreationDate"
            figure.savefig(path, metadata={date: None})
            figure.set_layout_engine("none")  # the layout is done; the second file shares it
    return paths


def draw_static(tables: Tables, styles: dict[str, Style], model: str, statistic: str) -> MplFigure:
    """Panels with matplotlib: error rows and a time row, a column per test."""
    runs = prepare(tables, model)
    tests, rows = list(dict.fromkeys(runs["test"])), list(dict.fromkeys(runs["row"]))
    figure = MplFigure(figsize=(2.3 * len(tests) + 0.8, 1.7 * (len(rows) + 1) + 0.9))
    axes = figure.subplots(len(rows) + 1, len(tests), sharex="col", sharey="row", squeeze=False)
    for r, row in enumerate([*rows, ""]):
        for c, test in enumerate(tests):
            cell = runs[(runs["test"] == test) & (row == "" or runs["row"] == row)]
            _draw_cell(axes[r][c], cell, "rmse" if row else "time_solve_s", styles, statistic)
            axes[r][c].set_ylabel((f"{row}\nRMSE" if row else "time (s)") if c == 0 else "")
            axes[r][c].set_xlabel("level" if r == len(rows) else "")
            axes[r][c].set_title(words(test) if r == 0 else "")
        if row:  # after the whole row is drawn, as it fixes the limits
            axes[r][0].set_ylim(bottom=0)
    handles = {
        text: handle
        for axis in axes.flat
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False
    )
    figure.suptitle(f"{tables.experiment}, {model}: {statistic} over trials")
    return figure


_PRINT: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 9,
    "svg.fonttype": "none",
    "svg.hashsalt": "dcreg",
    "figure.constrained_layout.use": True,
}


def _draw_cell(
    axes: Any, cell: pd.DataFrame, column: str, styles: dict[str, Style], statistic: str
) -> None:
    cell = cell[cell[column].notna()]
    if cell.empty:
        axes.set_axis_off()
        return
    for method, style in styles.items():
        groups = cell[cell["method"] == method].groupby("level")[column]
        line = groups.agg(statistic)
        if line.empty:
            continue
        axes.plot(
            line.index, line, style.mpl_line, color=style.light, marker=style.marker,
            markersize=4, linewidth=1.2, label=style.name,
        )  # fmt: skip
        if statistic == "median":
            low, high = groups.quantile(BAND[0]), groups.quantile(BAND[1])
            axes.fill_between(line.index, low, high, color=style.light, alpha=0.15, linewidth=0)
    if column == "time_solve_s":
        axes.set_yscale("log")
        return
    floor = cell.drop_duplicates("instance_id").groupby("level")["rmse_floor"].median().dropna()
    axes.plot(floor.index, floor, "--", color="#666666", linewidth=1, label=FLOOR)
