"""What the pages share: colours, a look for light and dark, and how they are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from dcreg.files import write_text
from dcreg.plot.page import Page

# Colours that stay apart for colour-blind readers (Okabe and Ito).
TARGET, SOURCE, GREY = "#0072B2", "#D55E00", "#7F7F7F"
LOWER, UPPER = "#009E73", "#CC79A7"
_FAINT, _CLEAR = "rgba(127, 127, 127, 0.3)", "rgba(0, 0, 0, 0)"


def figure(drawn: Sequence[go.BaseTraceType] = ()) -> go.Figure:
    """A figure for light and dark pages: the page paints its background and its words."""
    axis = {"gridcolor": _FAINT, "zerolinecolor": _FAINT, "automargin": True}
    solid = {"gridcolor": GREY, "zerolinecolor": GREY, "color": GREY, "showbackground": False}
    return go.Figure(
        list(drawn),
        go.Layout(
            template={"layout": {"xaxis": axis, "yaxis": axis}},
            scene=dict.fromkeys(("xaxis", "yaxis", "zaxis"), solid),
            paper_bgcolor=_CLEAR,
            plot_bgcolor=_CLEAR,
            modebar={"bgcolor": _CLEAR, "color": GREY},
            legend={"orientation": "h", "y": -0.16, "yanchor": "top"},
            margin={"l": 10, "r": 10, "t": 24, "b": 10},
        ),
    )


def write_page(
    path: Path,
    kind: str,
    names: tuple[str, str],
    status: str,
    drawn: Mapping[str, go.Figure],
    **more: Any,
) -> None:
    """Write a `Page` with these figures by caption, and `more` of its parts."""
    source, target = (Path(name).name for name in names)
    settings = {"displaylogo": False, "responsive": True}
    fragments = {  # ids by place, so that the same data give the same page
        caption: fig.to_html(
            full_html=False, include_plotlyjs=False, div_id=f"figure{at}", config=settings
        )
        for at, (caption, fig) in enumerate(drawn.items())
    }
    page = Page(f"{kind} of {source} to {target}", status, fragments, get_plotlyjs(), **more)
    write_text(path, page.html())
