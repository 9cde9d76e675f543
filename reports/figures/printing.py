"""Print an interactive figure: the same traces and axes, drawn with matplotlib.

The page and the printed figure share one description, so they cannot differ. Open markers mark runs at a
limit, open markers with a dot runs without a pose.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import seaborn as sns
from matplotlib.figure import Figure as MplFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from reports.figures.grid import Grid
from reports.theme import DASHES, SOURCE_COLOR, TARGET_COLOR, Style

FLOOR_COLOR = "#666666"
LIMITED, NO_POSE = "-open", "-open-dot"  # endings of plotly's symbols
_LEGEND_COLUMNS = 3  # at least
_LEGEND_ROW = 0.18  # inches
INK = {"light": "#1b2229", "dark": "#e6eaef"}
GRID = {"light": "#e8ebee", "dark": "#272e37"}


@contextmanager
def style(surface: str | None = None) -> Iterator[None]:
    """Draw in the style of all printed figures; on a light or dark `surface` without a background."""
    settings: dict[Any, Any] = {
        "font.size": 8,
        "axes.titlesize": 9,
        "svg.fonttype": "none",
        "svg.hashsalt": f"dcreg-{surface}",  # ids differ, as both drawings may share a page
        "figure.constrained_layout.use": True,
    }
    if surface:
        inked = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
        settings |= dict.fromkeys(inked, INK[surface]) | {"grid.color": GRID[surface]}
        settings |= {"axes.facecolor": "none", "figure.facecolor": "none"}
    with sns.axes_style("whitegrid"), matplotlib.rc_context(settings):
        yield


def save(figure: MplFigure, stem: Path, surface: str | None = None) -> list[Path]:
    """Write the figure as SVG and PDF; the same tables give the same files."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in ("svg", "pdf")]
    for path in paths:
        path.write_bytes(rendered(figure, path.suffix[1:], surface))
    return paths


def rendered(figure: MplFigure, kind: str, surface: str | None = None) -> bytes:
    """Return the figure as a file of a kind, without a creation date."""
    stream = io.BytesIO()
    date = "CreationDate" if kind == "pdf" else "Date"
    with style(surface):
        figure.savefig(stream, format=kind, metadata={date: None})
    figure.set_layout_engine(None)  # the layout is done; the next file shares it
    return stream.getvalue()


def draw(
    traces: list[dict[str, Any]],
    grid: Grid,
    styles: Mapping[str, Style],
    title: str,
    roles: Collection[str] | None = None,
) -> MplFigure:
    """Draw the panels of `grid` with `traces`, or only those of `roles`."""
    rows = max(panel.row for panel in grid.panels) + 1
    columns = len(grid.column_titles)
    with style():
        keys = _keys(traces, styles, roles)
        ncols = max(_LEGEND_COLUMNS, columns - 1)
        height = 1.7 * rows + 0.7 + _LEGEND_ROW * -(-len(keys) // ncols)
        figure = MplFigure(figsize=(2.3 * columns + 0.8, height))
        axes = figure.subplots(rows, columns, squeeze=False)
        placed = [axes[panel.row][panel.column] for panel in grid.panels]
        _share(grid, placed)
        for trace in traces:
            if roles is None or trace["meta"]["role"] in roles:
                _draw(placed[_index(trace["xaxis"])], trace, styles)
        for axis in set(axes.flat) - set(placed):
            axis.set_axis_off()
        _label(grid, placed)
        if keys:
            figure.legend(
                handles=keys,
                loc="outside lower center",
                ncols=ncols,
                frameon=False,
                handlelength=3.4,
            )
        figure.suptitle(title)
    return figure


def _index(name: str) -> int:
    """Return the index of the panel with an axis x, x2, x3, ..."""
    return int(name[1:] or 1) - 1


def _share(grid: Grid, placed: list[Any]) -> None:
    for index, panel in enumerate(grid.panels):
        axis = placed[index]
        if panel.equal:
            axis.set_aspect("equal", adjustable="datalim")
        first_x, first_y = grid.first_of_column(index), grid.first_of_row(index)
        if first_x != index:
            axis.sharex(placed[first_x])
        if first_y != index:
            axis.sharey(placed[first_y])
        axis.set_xscale(panel.x_type)
        axis.set_yscale(panel.y_type)


def _label(grid: Grid, placed: list[Any]) -> None:
    for index, panel in enumerate(grid.panels):
        axis = placed[index]
        lowest = max(p.row for p in grid.panels if p.column == panel.column)
        alone_x, alone_y = not panel.share_x, not panel.share_y
        axis.set_xlabel(panel.x_title if panel.row == lowest or alone_x else "")
        axis.set_ylabel(panel.y_title.replace("<br>", "\n") if panel.column == 0 or alone_y else "")
        axis.set_title(grid.column_titles[panel.column] if panel.row == 0 else "")
        if panel.hidden:
            axis.set_xticks([])
            axis.set_yticks([])
        if panel.x_ticks and panel.x_type == "linear":
            axis.set_xticks(panel.x_ticks, [f"{tick:g}" for tick in panel.x_ticks])
        for which, kind in ((axis.xaxis, panel.x_type), (axis.yaxis, panel.y_type)):
            if kind == "log":
                which.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                which.set_minor_formatter(NullFormatter())
        if panel.y_from_zero and panel.y_type == "linear":
            axis.set_ylim(bottom=0)


def _draw(axis: Any, trace: dict[str, Any], styles: Mapping[str, Style]) -> None:
    method, role = trace["meta"].get("method"), trace["meta"]["role"]
    style = styles[method] if method else None
    color = style.light if style else _COLORS.get(role, FLOOR_COLOR)
    x, y = (np.asarray(trace[name], dtype=float) for name in "xy")
    if trace.get("fill"):
        axis.fill(x, y, color=color, alpha=0.13, linewidth=0)
        return
    if "lines" in trace["mode"]:
        axis.plot(
            x, y, color=color, linestyle=_line(trace["line"].get("dash", "solid")), linewidth=1.2,
            drawstyle="steps-post" if trace["line"].get("shape") == "hv" else "default",
        )  # fmt: skip
    if "markers" in trace["mode"]:
        _draw_markers(axis, x, y, trace, style, color)


def _line(dash: str) -> Any:
    """Return a dash in matplotlib's notation."""
    return (0, DASHES[dash]) if DASHES[dash] else "-"


def _draw_markers(
    axis: Any, x: np.ndarray, y: np.ndarray, trace: dict[str, Any], style: Style | None, color: str
) -> None:
    symbols = np.broadcast_to(np.asarray(trace["marker"]["symbol"]), x.shape)
    opened = np.array([LIMITED in symbol for symbol in symbols])
    dotted = np.array([symbol.endswith(NO_POSE) for symbol in symbols])
    marker = style.marker if style else "+" if trace["meta"]["role"] == "target" else "o"
    for which, face in ((~opened, color), (opened, "white")):
        axis.plot(
            x[which], y[which], linestyle="none", marker=marker, markersize=4,
            markerfacecolor="none" if style is None else face, markeredgecolor=color,
            markeredgewidth=0.9,
        )  # fmt: skip
    axis.plot(x[dotted], y[dotted], linestyle="none", marker=".", markersize=2, color=color)


_COLORS = {"source": SOURCE_COLOR["light"], "target": TARGET_COLOR["light"]}


def _keys(
    traces: list[dict[str, Any]], styles: Mapping[str, Style], roles: Collection[str] | None
) -> list[Line2D]:
    """Return the legend entries of methods, floor, clouds and open markers."""
    drawn = [trace for trace in traces if roles is None or trace["meta"]["role"] in roles]
    methods = dict.fromkeys(trace["meta"].get("method") for trace in drawn)
    keys = [_key(styles[method]) for method in methods if method]
    floor = [trace["name"] for trace in drawn if trace["meta"]["role"] == "floor"]
    if floor:
        keys.append(Line2D([], [], color=FLOOR_COLOR, linestyle="--", label=floor[0]))
    for role, marker in (("source", "o"), ("target", "+")):
        if any(trace["meta"]["role"] == role for trace in drawn):
            keys.append(Line2D([], [], color=_COLORS[role], linestyle="none", marker=marker,
                               markerfacecolor="none", label=role))  # fmt: skip
    symbols = {
        str(symbol)
        for trace in drawn
        if "markers" in trace["mode"] and trace["meta"].get("method")
        for symbol in np.atleast_1d(trace["marker"]["symbol"])
    }
    for ending, text in (
        (LIMITED, "open: some runs hit a limit"),
        (NO_POSE, "dotted: some runs without a pose"),
    ):
        if any(symbol.endswith(ending) for symbol in symbols):
            keys.append(
                Line2D([], [], color="black", linestyle="none", marker="o", markersize=4,
                       markerfacecolor="white", label=text)
            )  # fmt: skip
    return keys


def _key(style: Style) -> Line2D:
    return Line2D(
        [], [], color=style.light, linestyle=_line(style.dash), marker=style.marker, markersize=4,
        linewidth=1.2, label=style.name,
    )  # fmt: skip
