"""One offline HTML page per registration: clouds before and after, bounds over time and work."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from dcreg.result import Result
from dcreg.trace import Event

# Colours that stay apart for colour-blind readers (Okabe and Ito).
_TARGET, _SOURCE, _PAIRS = "#0072B2", "#D55E00", "#7F7F7F"
_LOWER, _UPPER = "#009E73", "#CC79A7"
# Browsers become slow beyond this; larger clouds are thinned evenly for display only.
_MAX_POINTS = 20_000


def plot_registration(
    source: np.ndarray, target: np.ndarray, result: Result, path: str | Path
) -> None:
    """Write a self-contained page (plotly.js inside, no network needed).

    Parameters
    ----------
    source, target : (n, d) and (m, d) arrays, d = 2 or 3
    result : Result
    path : str or Path
        The HTML file to write.
    """
    figure(source, target, result).write_html(
        path, include_plotlyjs=True, div_id="registration", config={"displaylogo": False}
    )


def figure(source: np.ndarray, target: np.ndarray, result: Result) -> go.Figure:
    """The figure behind `plot_registration`."""
    cell = {"type": "scene" if source.shape[1] == 3 else "xy"}
    fig = make_subplots(
        rows=2,
        cols=2,
        specs=[[cell, cell], [{"type": "xy"}, {"type": "xy"}]],
        row_heights=[0.64, 0.36],
        vertical_spacing=0.1,
        subplot_titles=("before", "after", "bounds against time", "bounds against nodes"),
    )
    d = source.shape[1]
    moved = source @ result.T_target_source[:d, :d].T + result.T_target_source[:d, d]
    for column, cloud in ((1, source), (2, moved)):
        fig.add_trace(_points(target, "target", _TARGET, column), row=1, col=column)
        fig.add_trace(_points(cloud, "source", _SOURCE, column), row=1, col=column)
    fig.add_trace(_pair_lines(moved, target, result.assignment), row=1, col=2)
    _add_history(fig, result)
    if d == 3:
        fig.update_scenes(aspectmode="data")
    else:
        for column in (1, 2):
            fig.update_yaxes(scaleanchor=f"x{column if column > 1 else ''}", row=1, col=column)
    fig.update_layout(title=_title(result), template="plotly_white", height=900)
    return fig


def _title(result: Result) -> str:
    return (
        f"{result.model}: {result.status.value} (bounds on: {result.certificate_scope})<br>"
        f"<sup>gap {result.gap:.4g} (tolerance {result.gap_tol:.4g}), bounds "
        f"[{result.lower_bound:.5g}, {result.upper_bound:.5g}], {result.n_inliers} pairs, "
        f"RMSE {result.rmse_matched:.4g}</sup>"
    )


def _points(points: np.ndarray, name: str, color: str, column: int) -> go.Scatter | go.Scatter3d:
    step = -(-len(points) // _MAX_POINTS)
    size = 6 if points.shape[1] == 2 else 4 if len(points) < 1000 else 2
    return _scatter(
        points[::step],
        name=name if step == 1 else f"{name} (every {step}th point)",
        mode="markers",
        marker={"color": color, "size": size, "opacity": 0.8},
        legendgroup=name,
        showlegend=column == 1,
        customdata=np.arange(len(points))[::step],
        hovertemplate=f"{name} %{{customdata}}<extra></extra>",
    )


def _pair_lines(moved: np.ndarray, target: np.ndarray, pairs: np.ndarray) -> go.BaseTraceType:
    """All matched pairs as one broken line: a trace for each would be slow."""
    pairs = np.asarray(pairs, dtype=int).reshape(-1, 2)
    pairs = pairs[:: max(1, -(-len(pairs) // _MAX_POINTS))]
    gaps = np.full((len(pairs), target.shape[1]), np.nan)
    ends = np.stack([moved[pairs[:, 0]], target[pairs[:, 1]], gaps], axis=1)
    return _scatter(
        ends.reshape(-1, target.shape[1]),
        name="matched pairs",
        mode="lines",
        line={"color": _PAIRS, "width": 1.5},
        hoverinfo="skip",
    )


def _scatter(points: np.ndarray, **options: object) -> go.BaseTraceType:
    axes = dict(zip("xyz", points.T, strict=False))
    return (go.Scatter3d if points.shape[1] == 3 else go.Scatter)(**axes, **options)


def _add_history(fig: go.Figure, result: Result) -> None:
    """Bounds of the certified search; later stages bound other objectives and are left out."""
    events = [event for event in result.trace if event.stage == "search"] or list(result.trace)
    units = {1: ("time_s", "time in s"), 2: ("n_nodes", "nodes")}
    for column, (attribute, label) in units.items():
        for name, bound, color in (
            ("lower bound", "lower_bound", _LOWER),
            ("upper bound", "upper_bound", _UPPER),
        ):
            x, y = _finite(events, attribute, bound)
            fig.add_trace(
                go.Scatter(
                    x=x,
                    y=y,
                    name=name,
                    mode="lines+markers" if len(x) < 50 else "lines",
                    line={"color": color, "shape": "hv"},
                    legendgroup=name,
                    showlegend=column == 1,
                ),
                row=2,
                col=column,
            )
        fig.update_xaxes(title_text=label, row=2, col=column)
        fig.update_yaxes(title_text="squared units of the target", row=2, col=column)
        fig.add_hline(
            y=result.upper_bound - result.gap_tol,
            line={"color": _UPPER, "dash": "dot", "width": 1},
            annotation={"text": "upper bound - tolerance", "font": {"size": 10}},
            exclude_empty_subplots=False,  # plotly's check for empty ones fails beside 3D scenes
            row=2,
            col=column,
        )


def _finite(events: Sequence[Event], x: str, y: str) -> tuple[list[float], list[float]]:
    """Events whose bound exists; before the first pose the upper bound is infinite."""
    rows = [(getattr(event, x), getattr(event, y)) for event in events]
    rows = [row for row in rows if math.isfinite(row[1])]
    return [row[0] for row in rows], [row[1] for row in rows]
