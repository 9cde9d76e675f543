"""Print an interactive figure: the same traces and axes, drawn with matplotlib.

The page and the printed figure share one description, so they cannot differ. Open markers mark runs at a
limit, open markers with a dot runs without a pose.
"""

from __future__ import annotations

import io
import re
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
from reports.theme import (
    DASHES,
    LIMITED,
    NO_POSE,
    PART_COLORS,
    SOURCE_COLOR,
    SURFACE,
    TARGET_COLOR,
    Style,
)

FLOOR_COLOR = "#666666"
_LEGEND_COLUMNS = 3  # at least
_LEGEND_ROW = 0.18  # inches
_PHONE = 4.2  # inches: the width of a stacked drawing, whose text is legible on a phone
_PAGE_SCALE = 115  # pixels of a page per inch, at most
INK = {"light": "#1b2229", "dark": "#e6eaef"}
GRID = {"light": "#e8ebee", "dark": "#272e37"}


@contextmanager
def style(surface: str | None = None, name: str = "") -> Iterator[None]:
    """Draw in the style of all printed figures; on a light or dark `surface` without a background."""
    settings: dict[Any, Any] = {
        "font.size": 8,
        "axes.titlesize": 9,
        "svg.fonttype": "none",
        "svg.hashsalt": f"dcreg-{surface}{name}",  # ids differ, because drawings may share a page
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


def rendered(figure: MplFigure, kind: str, surface: str | None = None, name: str = "") -> bytes:
    """Return the figure as a file of a kind, without a creation date."""
    stream = io.BytesIO()
    date = "CreationDate" if kind == "pdf" else "Date"
    with style(surface, name):
        figure.savefig(stream, format=kind, metadata={date: None})
    figure.set_layout_engine(None)  # the layout is done; the next file shares it
    return stream.getvalue()


def inline(figure: MplFigure, styles: Mapping[str, Style], name: str) -> str:
    """Return SVG for a page, in which every colour follows the theme; ids are unique by `name`."""
    text = rendered(figure, "svg", "light", name).decode()
    colors = {style.light: style.dark for style in styles.values()}
    colors |= {pair["light"]: pair["dark"] for pair in (*_COLORS.values(), INK, GRID, SURFACE)}
    # what seaborn's style and this module draw in black, white and grey
    colors |= {"#262626": INK["dark"], "#000000": INK["dark"], "#cccccc": GRID["dark"]}
    colors |= {FLOOR_COLOR: "#9aa6b2"}
    svg = re.sub(
        "|".join(map(re.escape, colors)),
        lambda found: f"light-dark({found.group()}, {colors[found.group()]})",
        text[text.index("<svg") :],
    )
    width = _PAGE_SCALE * figure.get_figwidth()
    return svg.replace("<svg ", f'<svg style="max-width: {width:.0f}px" ', 1)


def draw(
    traces: list[dict[str, Any]],
    grid: Grid,
    styles: Mapping[str, Style],
    title: str,
    roles: Collection[str] | None = None,
    *,
    stacked: bool = False,
    photographs: Mapping[int, np.ndarray] | None = None,
) -> MplFigure:
    """Draw the panels of `grid` with `traces`, or only those of `roles`.

    A `stacked` drawing is for a phone: panels below each other, or in pairs if they hold clouds.
    `photographs` are drawn behind the panels with these indices.
    """
    with style():
        keys = _keys(traces, styles, roles)
        figure, placed = _panels(grid, len(keys), stacked)
        _share(grid, placed)
        for index, picture in (photographs or {}).items():
            height, width = picture.shape
            placed[index].imshow(
                picture, cmap="gray", vmin=0, vmax=1, alpha=0.45, extent=(0, width, -height, 0)
            )
        for trace in traces:
            if roles is None or trace["meta"]["role"] in roles:
                _draw(placed[_index(trace["xaxis"])], trace, styles)
        _label(grid, placed, stacked)
        if keys:
            figure.legend(
                handles=keys,
                loc="outside lower center",
                ncols=_legend_columns(grid, stacked),
                frameon=False,
                handlelength=3.4,
            )
        figure.suptitle(title)
    return figure


def _legend_columns(grid: Grid, stacked: bool) -> int:
    return 2 if stacked else max(_LEGEND_COLUMNS, len(grid.column_titles) - 1)


def _panels(grid: Grid, n_keys: int, stacked: bool) -> tuple[MplFigure, list[Any]]:
    """Return an empty figure and the axes of each panel."""
    legend = _LEGEND_ROW * -(-n_keys // _legend_columns(grid, stacked))
    if not stacked:
        rows = max(panel.row for panel in grid.panels) + 1
        columns = len(grid.column_titles)
        figure = MplFigure(figsize=(2.3 * columns + 0.8, 1.7 * rows + 0.7 + legend))
        cells = [(panel.row, panel.column) for panel in grid.panels]
    else:
        columns = 2 if all(panel.hidden for panel in grid.panels) else 1
        rows = -(-len(grid.panels) // columns)
        figure = MplFigure(figsize=(_PHONE, 1.9 * rows + 0.3 + legend))
        order = sorted(grid.panels, key=lambda panel: (panel.column, panel.row))
        if columns == 2:  # clouds: the panels of a row belong together
            order = sorted(grid.panels, key=lambda panel: (panel.row, panel.column))
        cells = [divmod(order.index(panel), columns) for panel in grid.panels]
    axes = figure.subplots(rows, columns, squeeze=False)
    placed = [axes[row][column] for row, column in cells]
    for axis in set(axes.flat) - set(placed):
        axis.set_axis_off()
    return figure, placed


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


def _label(grid: Grid, placed: list[Any], stacked: bool) -> None:
    for index, panel in enumerate(grid.panels):
        axis = placed[index]
        lowest = max(p.row for p in grid.panels if p.column == panel.column)
        alone_x, alone_y = stacked or not panel.share_x, stacked or not panel.share_y
        axis.set_xlabel(panel.x_title if panel.row == lowest or alone_x else "")
        axis.set_ylabel(panel.y_title.replace("<br>", "\n") if panel.column == 0 or alone_y else "")
        titled = panel.row == 0 or (stacked and panel.hidden)
        axis.set_title(grid.column_titles[panel.column] if titled else "")
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
    color = style.light if style else _COLORS[role]["light"] if role in _COLORS else FLOOR_COLOR
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
    opened = np.array([LIMITED in symbol for symbol in symbols], dtype=bool)
    dotted = np.array([symbol.endswith(NO_POSE) for symbol in symbols], dtype=bool)
    role = trace["meta"]["role"]
    marker = style.marker if style else {"target": "+", "floor": "_"}.get(role, "o")
    for which, face in ((~opened, color), (opened, "white")):
        axis.plot(
            x[which], y[which], linestyle="none", marker=marker, markersize=4,
            markerfacecolor="none" if role in ("source", "target") else face, markeredgecolor=color,
            markeredgewidth=0.9,
        )  # fmt: skip
    axis.plot(x[dotted], y[dotted], linestyle="none", marker=".", markersize=2, color=color)


_COLORS = {"source": SOURCE_COLOR, "target": TARGET_COLOR, **PART_COLORS}


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
            keys.append(Line2D([], [], color=_COLORS[role]["light"], linestyle="none",
                               marker=marker, markerfacecolor="none", label=role))  # fmt: skip
    parts = {trace["name"]: trace for trace in drawn if trace["meta"]["role"] in PART_COLORS}
    keys += [_part_key(trace) for trace in parts.values()]
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


def _part_key(trace: dict[str, Any]) -> Line2D:
    """Return the legend entry of a part of a drawing of the method."""
    look = trace.get("line", {}).get("dash", "solid")
    return Line2D(
        [], [], color=PART_COLORS[trace["meta"]["role"]]["light"], markersize=4, linewidth=1.2,
        linestyle=_line(look) if "lines" in trace["mode"] else "none",
        marker="o" if "markers" in trace["mode"] else None, label=trace["name"],
    )  # fmt: skip


def _key(style: Style) -> Line2D:
    return Line2D(
        [], [], color=style.light, linestyle=_line(style.dash), marker=style.marker, markersize=4,
        linewidth=1.2, label=style.name,
    )  # fmt: skip
