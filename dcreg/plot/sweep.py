"""The curves of a sweep, as a page or an image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dcreg.files import whole_file
from dcreg.names import FIGURE_PACKAGES
from dcreg.plot.style import GREY, LOWER, SOURCE, TARGET, figure, write_page
from dcreg.problem import InputError
from dcreg.sweep_result import SweepResult


def plot_sweep(
    sweep: SweepResult, path: str | Path, *, names: tuple[str, str] = ("source", "target")
) -> None:
    """Write residual and cost of the next pair against the cardinality, to choose one.

    Parameters
    ----------
    sweep : SweepResult
    path : str or Path
        An ``.html`` file becomes a page with plotly inside; a ``.png`` or ``.svg`` image needs
        matplotlib and seaborn.
    names : (str, str)
        What the page calls the clouds, such as the names of their files.

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
        headings, rows = sweep.table()
        write_page(
            path,
            "sweep",
            names,
            _sweep_title(sweep),
            sweep_figures(sweep),
            warnings=sweep.warnings,
            headings=headings,
            rows=rows,
            notes=sweep.notes(),
        )
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
_SUGGESTION = "suggestion: {} pairs"
_BAND = "range left open by the bounds"
_POSE_CURVE = "RMSE of the final pose"


def sweep_figures(sweep: SweepResult) -> dict[str, go.Figure]:
    """The figures of the page of `plot_sweep`, by caption."""
    curves = _sweep_curves(sweep)
    drawn = {}
    for curve, color in zip(curves, (TARGET, SOURCE), strict=True):
        band = go.Scatter(
            x=np.concatenate([curve.x, curve.x[::-1]]),
            y=np.concatenate([curve.high, curve.low[::-1]]),
            name=_BAND,
            fill="toself",
            fillcolor=color,
            opacity=0.25,
            line={"width": 0},
            mode="lines",
            hoverinfo="skip",
        )
        line = go.Scatter(
            x=curve.x, y=curve.y, name="by the upper bound", mode="lines+markers",
            line={"color": color}, showlegend=True,
        )  # fmt: skip
        fig = drawn[curve.name] = figure([band, line])
        for suggested in _suggestions(sweep):
            fig.add_vline(
                x=suggested,
                line={"color": LOWER, "dash": "dot"},
                name=_SUGGESTION.format(suggested),
                showlegend=True,
            )
        fig.update_xaxes(title_text=_AXES[0])
        fig.update_yaxes(title_text=_AXES[1], rangemode="tozero")
    rmse = _final_rmse(sweep)
    if rmse is not None:
        drawn[curves[0].name].add_scatter(
            x=curves[0].x, y=rmse, name=_POSE_CURVE, line={"color": GREY, "dash": "dash"}
        )
    return drawn


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
        for ax, curve, color in zip(axes, _sweep_curves(sweep), (TARGET, SOURCE), strict=True):
            ax.fill_between(
                curve.x, curve.low, curve.high, color=color, alpha=0.25, linewidth=0,
                label=_BAND,
            )  # fmt: skip
            ax.plot(curve.x, curve.y, "o-", color=color, markersize=4, label=curve.name)
            for suggested in _suggestions(sweep):
                label = _SUGGESTION.format(suggested)
                ax.axvline(suggested, color=LOWER, linestyle=":", label=label)
            ax.set(title=curve.name, xlabel=_AXES[0], ylabel=_AXES[1])
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        rmse = _final_rmse(sweep)
        if rmse is not None:
            ks = [result.n_inliers for result in sweep.results]
            axes[0].plot(ks, rmse, "--", color=GREY, label=_POSE_CURVE)
        for ax in axes:
            ax.set_ylim(bottom=0.0)
            ax.legend(fontsize="small")
        fig.suptitle(_sweep_title(sweep), fontsize="medium")
        metadata = {"Date": None} if kind == "svg" else None  # the same sweep, the same file
        fig.savefig(path, format=kind, dpi=150, metadata=metadata)
