"""The curves of a sweep, as a page or an image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dcreg.files import whole_file
from dcreg.names import FIGURE_PACKAGES
from dcreg.plot.page import GREY, LOWER, SOURCE, TARGET, figure, page_title, write_page
from dcreg.problem import InputError
from dcreg.sweep_result import SweepResult


def plot_sweep(
    sweep: SweepResult, path: str | Path, *, names: tuple[str, str] = ("source", "target")
) -> None:
    """Write a figure of the RMS residual and the marginal cost against the number of pairs.

    Parameters
    ----------
    sweep : SweepResult
    path : str or Path
        An ``.html`` page, or a ``.png`` or ``.svg`` image, which needs matplotlib and seaborn.
    names : (str, str)
        Names of the clouds on the page, such as their file names.

    Raises
    ------
    InputError
        If `path` has another suffix.
    """
    path = Path(path)
    suffix, known = path.suffix.lower(), " or ".join(FIGURE_PACKAGES)
    if suffix not in FIGURE_PACKAGES:
        raise InputError(f"{path}: the suffix {suffix!r} is not supported; use {known}")
    if suffix == ".html":
        write_page(
            path, page_title("sweep", names), _sweep_title(sweep), sweep_figures(sweep),
            warnings=sweep.warnings, table=sweep.table(), notes=sweep.notes(),
        )  # fmt: skip
    else:
        with whole_file(path) as part:
            _sweep_image(sweep, part, suffix.removeprefix("."))


@dataclass(frozen=True)
class _Curve:
    """A line with a band around it, and in 3D the RMSE of the final poses."""

    name: str
    color: str
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray
    high: np.ndarray
    of_poses: np.ndarray | None = None


def _sweep_curves(sweep: SweepResult) -> tuple[_Curve, _Curve]:
    """Return the residual per pair and the residual of the next pair, both as lengths.

    Between numbers of pairs that are not consecutive, the latter is a mean.
    """
    rows = sweep.rows()
    k, rms, low = (_column(rows, name) for name in ("n_inliers", "rms", "rms_lower"))
    # in 2D the bounds refer to the final poses
    of_poses = None if sweep.results[0].model == "similarity2d" else _column(rows, "rmse_matched")
    residual = _Curve("RMS residual, √(E(k) / k)", TARGET, k, rms, low, rms, of_poses)
    names = ("marginal_cost", "marginal_cost_lower", "marginal_cost_upper")
    following = [np.sqrt(_column(rows[:-1], name)) for name in names]
    centres = 0.5 * (k[:-1] + k[1:])
    name = "residual of the next pair, √(E(k+1) − E(k))"
    return residual, _Curve(name, SOURCE, centres, *following)


def _column(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows], dtype=float)


def _sweep_title(sweep: SweepResult) -> str:
    first = sweep.results[0]
    n_proven = sum(result.success for result in sweep.results)
    return (
        f"{first.model}: {n_proven} of {len(sweep.results)} numbers of pairs certified "
        f"(bounds on: {first.certificate_scope})"
    )


_AXES = ("pairs to match (n_inliers)", "units of the target")
_SUGGESTION = "suggestion: {} pairs"
_BAND = "range between the bounds"
_POSE_CURVE = "RMSE of the final pose"


def sweep_figures(sweep: SweepResult) -> dict[str, go.Figure]:
    """Return the figures of the page of `plot_sweep`, by caption."""
    drawn = {}
    for curve in _sweep_curves(sweep):
        around = np.concatenate([curve.high, curve.low[::-1]])
        band = go.Scatter(
            x=np.concatenate([curve.x, curve.x[::-1]]), y=around, name=_BAND, fill="toself",
            fillcolor=curve.color, opacity=0.25, line={"width": 0}, mode="lines", hoverinfo="skip",
        )  # fmt: skip
        line = go.Scatter(
            x=curve.x, y=curve.y, name="from the upper bound", mode="lines+markers",
            line={"color": curve.color}, showlegend=True,
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
        if curve.of_poses is not None:
            dashed = {"color": GREY, "dash": "dash"}
            fig.add_scatter(x=curve.x, y=curve.of_poses, name=_POSE_CURVE, line=dashed)
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
        for ax, curve in zip(fig.subplots(1, 2), _sweep_curves(sweep), strict=True):
            ax.fill_between(
                curve.x, curve.low, curve.high, color=curve.color, alpha=0.25, linewidth=0,
                label=_BAND,
            )  # fmt: skip
            ax.plot(curve.x, curve.y, "o-", color=curve.color, markersize=4, label=curve.name)
            for suggested in _suggestions(sweep):
                label = _SUGGESTION.format(suggested)
                ax.axvline(suggested, color=LOWER, linestyle=":", label=label)
            ax.set(title=curve.name, xlabel=_AXES[0], ylabel=_AXES[1])
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
            if curve.of_poses is not None:
                ax.plot(curve.x, curve.of_poses, "--", color=GREY, label=_POSE_CURVE)
            ax.set_ylim(bottom=0.0)
            ax.legend(fontsize="small")
        fig.suptitle(_sweep_title(sweep), fontsize="medium")
        metadata = {"Date": None} if kind == "svg" else None  # the same sweep gives the same file
        fig.savefig(path, format=kind, dpi=150, metadata=metadata)
