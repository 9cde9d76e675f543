"""A page that needs no network, and the style of its figures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from textwrap import dedent

import plotly.graph_objects as go

from dcreg.files import write_text
from dcreg.plot.packing import UNPACK, pack, packed_plotly
from dcreg.problem import InputError

# Colours that colour-blind readers can distinguish (Okabe and Ito).
TARGET, SOURCE, GREY = "#0072B2", "#D55E00", "#7F7F7F"
LOWER, UPPER = "#009E73", "#CC79A7"
_FAINT, _CLEAR = "rgba(127, 127, 127, 0.3)", "rgba(0, 0, 0, 0)"
_MATRIX = re.compile(r"[-+.\dena\s]+")  # also nan
_STYLE = Path(__file__).with_name("page.css")
_DRAW = """
const drawn = (async () => {
  const [library, figures] = await Promise.all([
    loadPlotly(document.getElementById("plotly").textContent),
    unpacked(document.getElementById("data").textContent).json(),
  ]);
  const config = { displaylogo: false, responsive: true };
  const draw = ({ data, layout }, at) => {
    const { eye } = layout.scene.camera;
    // Plotly scales a scene by the height of its figure; move back so that it fits the width of a phone
    if (window.innerWidth < 600) for (const axis in eye) eye[axis] *= 1.35;
    return library.newPlot(`figure${at}`, data, layout, config);
  };
  await Promise.all(figures.map(draw));
})();
"""


def figure(drawn: Sequence[go.BaseTraceType] = ()) -> go.Figure:
    """Return a figure for light and dark pages: the page sets its background and text colour."""
    axis = {"gridcolor": _FAINT, "zerolinecolor": _FAINT, "automargin": True}
    solid = {"gridcolor": GREY, "zerolinecolor": GREY, "color": GREY, "showbackground": False}
    return go.Figure(
        list(drawn),
        go.Layout(
            template={"layout": {"xaxis": axis, "yaxis": axis}},
            scene={
                **dict.fromkeys(("xaxis", "yaxis", "zaxis"), solid),
                "camera": {"eye": {"x": 1.7, "y": 1.7, "z": 1.3}},
            },
            paper_bgcolor=_CLEAR,
            plot_bgcolor=_CLEAR,
            modebar={"bgcolor": _CLEAR, "color": GREY},
            # below the title of the x axis, however far that is
            legend={"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom"},
            margin={"l": 10, "r": 10, "t": 24, "b": 10},
        ),
    )


def write_page(
    path: Path,
    title: str,
    status: str,
    figures: Mapping[str, go.Figure],
    *,
    warnings: Sequence[str] = (),
    facts: Sequence[tuple[str, str]] = (),
    table: tuple[Sequence[str], Sequence[Sequence[str]]] = ((), ()),
    notes: Sequence[str] = (),
) -> None:
    """Write a page with `figures` by caption, names and values (`facts`), a table and notes below it."""
    body = ["<main>", f"<h1>{escape(title)}</h1>", f'<p class="status">{escape(status)}</p>']
    if warnings:
        items = "".join(f"<li>{escape(warning)}</li>" for warning in warnings)
        body.append(f'<ul class="warnings">{items}</ul>')
    body.append('<div class="figures">')
    for at, caption in enumerate(figures):
        body.append(f"<figure><figcaption>{escape(caption)}</figcaption>")
        label = f'role="group" aria-label="{escape(caption)}"'
        body.append(f'<div class="plot" id="figure{at}" {label}></div></figure>')
    body.append("</div>")
    if facts:
        body.append(f"<dl>{''.join(_fact(name, value) for name, value in facts)}</dl>")
    headings, rows = table
    if rows:
        cells = "\n".join([_cells("th", headings), *(_cells("td", row) for row in rows)])
        body.append(f'<div class="scroll" tabindex="0"><table>\n{cells}\n</table></div>')
    body += [*(f'<p class="notes">{escape(note)}</p>' for note in notes), "</main>"]
    head = [
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>",
        f"<style>\n{_STYLE.read_text(encoding='utf-8')}</style>\n</head>\n<body>",
    ]
    write_text(path, "\n".join([*head, *body, *_scripts(figures), "</body>\n</html>\n"]))


def _scripts(figures: Mapping[str, go.Figure]) -> list[str]:
    """Return plotly.js and the figures, packed, and the script that draws them."""
    data = ",".join(fig.to_json(remove_uids=True) for fig in figures.values())
    return [
        f'<script type="text/plain" id="plotly">{packed_plotly()}</script>',
        f'<script type="text/plain" id="data">{pack(f"[{data}]".encode())}</script>',
        f"<script>\n{UNPACK.read_text(encoding='utf-8')}{_DRAW}</script>",
    ]


def html_file(path: str | Path) -> Path:
    """Return the path of a page.

    Raises
    ------
    InputError
        If the path has another suffix.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise InputError(f"{path}: the suffix {path.suffix!r} is not supported; use .html")
    return path


def page_title(kind: str, names: tuple[str, str]) -> str:
    """Return the title of a page about two files."""
    source, target = (Path(name).name for name in names)
    return f"{kind} of {source} to {target}"


def _fact(name: str, value: str) -> str:
    if "\n" not in value:
        return f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
    # a matrix is shown as it stands, and a narrow screen scrolls it; lines of words wrap
    kind, scrolls = ("matrix", ' tabindex="0"') if _MATRIX.fullmatch(value) else ("lines", "")
    block = escape(dedent(value))
    return f'<div class="{kind}"><dt>{escape(name)}</dt><dd{scrolls}>{block}</dd></div>'


def _cells(tag: str, values: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{tag}>{escape(value)}</{tag}>' for value in values)}</tr>"
