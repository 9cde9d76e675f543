"""Figures without a network: a page per registration, and a sweep's curves as a page or an image."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dcreg.files import whole_file
from dcreg.names import FIGURE_PACKAGES
from dcreg.problem import InputError
from dcreg.result import Result
from dcreg.search import Event
from dcreg.sweep_result import SweepResult

try:
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "figures need plotly, which is missing here; install it with: pip install plotly",
        name=error.name,
    ) from None

# Colours that stay apart for colour-blind readers (Okabe and Ito).
_TARGET, _SOURCE, _PAIRS = "#0072B2", "#D55E00", "#7F7F7F"
_LOWER, _UPPER = "#009E73", "#CC79A7"
# Browsers become slow beyond this; larger clouds are thinned evenly for display only.
_MAX_POINTS = 20_000


def plot_registration(
    source: np.ndarray, target: np.ndarray, result: Result, path: str | Path
) -> None:
    """Write a page with the clouds before and after, their pairs, and the bounds against time and work.

    The page needs no network: plotly.js is written into it.

    Parameters
    ----------
    source, target : (n, d) and (m, d) arrays, d = 2 or 3
    result : Result
    path : str or Path
        The ``.html`` file to write.

    Raises
    ------
    InputError
        For another suffix.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise InputError(f"{path}: {path.suffix!r} is no page; the name must end in .html")
    _write_page(figure(source, target, result), path, "registration")


def _write_page(fig: go.Figure, path: str | Path, div_id: str) -> None:
    with whole_file(path) as part:
        fig.write_html(part, include_plotlyjs=True, div_id=div_id, config={"displaylogo": False})


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


# --- sweep ----------------------------------------------------------------------------------------


def plot_sweep(sweep: SweepResult, path: str | Path) -> None:
    """Write residual and cost of the next pair against the cardinality, to choose one.

    Parameters
    ----------
    sweep : SweepResult
    path : str or Path
        An ``.html`` file becomes a page with plotly inside; a ``.png`` or ``.svg`` image needs
        matplotlib and seaborn.

    Raises
    ------
    InputError
        For another suffix.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FIGURE_PACKAGES:
        raise InputError(
            f"{path}: {suffix!r} is no kind of figure; the name must end in one of "
            f"{', '.join(FIGURE_PACKAGES)}"
        )
    if suffix == ".html":
        _write_page(sweep_figure(sweep), path, "sweep")
    else:
        with whole_file(path) as part:
            _sweep_image(sweep, part, suffix.removeprefix("."))


@dataclass(frozen=True)
class _Curve:
    """A line with a band around it."""

    name: str
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _sweep_curves(sweep: SweepResult) -> tuple[_Curve, _Curve]:
    """Residual per pair, and residual of the next pair; both are lengths.

    Between cardinalities that are not neighbours the latter is a mean over the pairs between them.
    """
    rows = sweep.rows()
    k, rms, low = (_column(rows, name) for name in ("n_inliers", "rms", "rms_low"))
    residual = _Curve("RMS residual, √(E(k) / k)", k, rms, low, rms)
    names = ("next_pair", "next_pair_low", "next_pair_high")
    following = [np.sqrt(_column(rows[:-1], name)) for name in names]
    middles = 0.5 * (k[:-1] + k[1:])
    return residual, _Curve("residual of the next pair, √(E(k+1) − E(k))", middles, *following)


def _column(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows], dtype=float)


def _final_rmse(sweep: SweepResult) -> np.ndarray | None:
    """RMSE of the final poses, where the bounds speak of another objective: in 3D."""
    if sweep.results[0].model == "similarity2d":
        return None
    return np.array([result.rmse_matched for result in sweep.results])


def _sweep_title(sweep: SweepResult) -> str:
    first = sweep.results[0]
    n_proven = sum(result.success for result in sweep.results)
    return (
        f"{first.model}: {n_proven} of {len(sweep.results)} cardinalities certified "
        f"(bounds on: {first.certificate_scope})"
    )


_AXES = ("pairs to match (n_inliers)", "units of the target")
_SUGGESTION = "suggestion: elbow at {}"


def sweep_figure(sweep: SweepResult) -> go.Figure:
    """The figure behind the page of `plot_sweep`."""
    curves = _sweep_curves(sweep)
    fig = make_subplots(
        rows=1, cols=2, subplot_titles=[curve.name for curve in curves], horizontal_spacing=0.1
    )
    for column, (curve, color) in enumerate(zip(curves, (_TARGET, _SOURCE), strict=True), start=1):
        fig.add_trace(
            go.Scatter(
                x=np.concatenate([curve.x, curve.x[::-1]]),
                y=np.concatenate([curve.high, curve.low[::-1]]),
                name=f"{curve.name}: range left open by the bounds",
                fill="toself",
                fillcolor=color,
                opacity=0.25,
                line={"width": 0},
                mode="lines",
                hoverinfo="skip",
            ),
            row=1,
            col=column,
        )
        fig.add_trace(
            go.Scatter(
                x=curve.x, y=curve.y, name=curve.name, mode="lines+markers", line={"color": color}
            ),
            row=1,
            col=column,
        )
    rmse = _final_rmse(sweep)
    if rmse is not None:
        line = {"color": _PAIRS, "dash": "dash"}
        fig.add_trace(
            go.Scatter(x=curves[0].x, y=rmse, name="RMSE of the final pose", line=line),
            row=1,
            col=1,
        )
    for column, suggested in itertools.product((1, 2), _suggestions(sweep)):
        fig.add_vline(
            x=suggested,
            line={"color": _LOWER, "dash": "dot"},
            annotation={"text": _SUGGESTION.format(suggested)} if column == 1 else None,
            row=1,
            col=column,
        )
    fig.update_xaxes(title_text=_AXES[0])
    fig.update_yaxes(title_text=_AXES[1], rangemode="tozero")
    legend = {"orientation": "h", "y": -0.2}
    fig.update_layout(title=_sweep_title(sweep), template="plotly_white", height=520, legend=legend)
    return fig


def _suggestions(sweep: SweepResult) -> list[int]:
    suggested = sweep.suggested_n_inliers
    return [] if suggested is None else [suggested]


def _sweep_image(sweep: SweepResult, path: Path, kind: str) -> None:
    # only images need these packages
    import seaborn as sns
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    settings = {**sns.axes_style("whitegrid"), "svg.hashsalt": "dcreg", "svg.fonttype": "none"}
    with rc_context(settings):
        fig = Figure(figsize=(10, 4), layout="constrained")
        axes = fig.subplots(1, 2)
        for ax, curve, color in zip(axes, _sweep_curves(sweep), (_TARGET, _SOURCE), strict=True):
            ax.fill_between(
                curve.x, curve.low, curve.high, color=color, alpha=0.25, linewidth=0,
                label="range left open by the bounds",
            )  # fmt: skip
            ax.plot(curve.x, curve.y, "o-", color=color, markersize=4, label=curve.name)
            for suggested in _suggestions(sweep):
                label = _SUGGESTION.format(suggested)
                ax.axvline(suggested, color=_LOWER, linestyle=":", label=label)
            ax.set(title=curve.name, xlabel=_AXES[0], ylabel=_AXES[1])
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        rmse = _final_rmse(sweep)
        if rmse is not None:
            ks = [result.n_inliers for result in sweep.results]
            axes[0].plot(ks, rmse, "--", color=_PAIRS, label="RMSE of the final pose")
        for ax in axes:
            ax.set_ylim(bottom=0.0)
            ax.legend(fontsize="small")
        fig.suptitle(_sweep_title(sweep), fontsize="medium")
        metadata = {"Date": None} if kind == "svg" else None  # the same sweep, the same file
        fig.savefig(path, format=kind, dpi=150, metadata=metadata)
