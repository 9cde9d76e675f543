"""The page of one registration: clouds before and after, matched pairs, and bounds of all stages."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dcreg.plot.page import (
    GREY,
    LOWER,
    SOURCE,
    TARGET,
    UPPER,
    figure,
    html_file,
    page_title,
    write_page,
)
from dcreg.problem import apply_pose
from dcreg.result import Result
from dcreg.search import Event

# Larger clouds and longer histories are thinned, for display only: the page stays below 2 MB.
_MAX_POINTS, _MAX_EVENTS = 1500, 500
_DIGITS = 4  # of coordinates, relative to the size of the cloud
_LABELLED = 0.1  # a stage shows its name if it takes this fraction of the width


def plot_registration(
    source: np.ndarray,
    target: np.ndarray,
    result: Result,
    path: str | Path,
    *,
    names: tuple[str, str] = ("source", "target"),
) -> None:
    """Write a page with the clouds before and after, matched pairs, and bounds against time and work.

    The page contains plotly.js and needs no network. It has at most 2 MB: coordinates are rounded, and
    large clouds and long histories thinned, for display only.

    Parameters
    ----------
    source, target : (n, d) and (m, d) arrays, d = 2 or 3
    result : Result
    path : str or Path
        The ``.html`` file to write.
    names : (str, str)
        Names of the clouds on the page, such as their file names.

    Raises
    ------
    InputError
        If `path` has another suffix.
    """
    file = html_file(path)
    entries = list(result.entries())
    facts = [(name, value) for name, value in entries if name not in ("status", "warning")]
    write_page(
        file,
        page_title("registration", names),
        dict(entries)["status"],
        figures(source, target, result),
        warnings=result.warnings,
        facts=facts,
    )


def figures(source: np.ndarray, target: np.ndarray, result: Result) -> dict[str, go.Figure]:
    """Return the figures of the page of `plot_registration`, by caption."""
    moved = apply_pose(result.T_target_source, source)
    stages = _stages(result.trace)
    pairs = _pair_lines(moved, target, result.assignment)
    most = max(len(source), len(target), len(result.assignment))
    thinned = f", at most {_MAX_POINTS:,} points and pairs shown" if most > _MAX_POINTS else ""
    return {
        f"before{thinned}": clouds_figure(source, target),
        f"after{thinned}": clouds_figure(moved, target, pairs),
        "bounds against time": _history(result, stages, "time_s", "time in s"),
        "bounds against nodes": _history(result, stages, "n_nodes", "nodes, all stages together"),
    }


def clouds_figure(source: np.ndarray, target: np.ndarray, *more: go.BaseTraceType) -> go.Figure:
    """Return both clouds in one figure, with more traces."""
    drawn = [*more, _points(target, "target", TARGET), _points(source, "source", SOURCE, ring=True)]
    fig = figure(drawn)
    if source.shape[1] == 3:
        fig.update_scenes(aspectmode="data")
    else:
        fig.update_yaxes(scaleanchor="x")
    return fig


def _points(points: np.ndarray, name: str, color: str, *, ring: bool = False) -> go.BaseTraceType:
    """Return a cloud as dots or, larger, as rings: a ring leaves the dot of its partner visible."""
    step = -(-len(points) // _MAX_POINTS)
    size = 6 if points.shape[1] == 2 else 4 if len(points) < 1000 else 2
    return _scatter(
        points[::step],
        name=name if step == 1 else f"{name} (1 of {step} points)",
        mode="markers",
        marker={
            "color": color,
            "size": 1.5 * size if ring else size,
            "symbol": "circle-open" if ring else "circle",
            "opacity": 0.8,
        },
        customdata=np.arange(len(points))[::step],
        hovertemplate=f"{name} %{{customdata}}<extra></extra>",
    )


def _pair_lines(moved: np.ndarray, target: np.ndarray, pairs: np.ndarray) -> go.BaseTraceType:
    """Return all matched pairs as one interrupted line; one trace for each pair would be slow."""
    pairs = np.asarray(pairs, dtype=int).reshape(-1, 2)
    pairs = pairs[:: max(1, -(-len(pairs) // _MAX_POINTS))]
    gaps = np.full((len(pairs), target.shape[1]), np.nan)
    ends = np.stack([moved[pairs[:, 0]], target[pairs[:, 1]], gaps], axis=1)
    return _scatter(
        ends.reshape(-1, target.shape[1]),
        name="matched pairs",
        mode="lines",
        line={"color": GREY, "width": 1.5},
        legendrank=1001,  # last, although it is below the points
        hoverinfo="skip",
    )


def _scatter(points: np.ndarray, **options: object) -> go.BaseTraceType:
    axes = dict(zip("xyz", _rounded(points).T.tolist(), strict=False))
    return (go.Scatter3d if points.shape[1] == 3 else go.Scatter)(**axes, **options)


def _rounded(points: np.ndarray) -> np.ndarray:
    """Round coordinates to `_DIGITS` digits of the extent of the points."""
    if not len(points):
        return points
    extent = float(np.max(np.nanmax(points, axis=0) - np.nanmin(points, axis=0)))
    return points.round(_DIGITS - math.floor(math.log10(extent))) if extent > 0.0 else points


@dataclass(frozen=True)
class _Stage:
    """The events of one stage, and the number of nodes of the earlier stages."""

    name: str
    events: list[Event]
    nodes_before: int

    def at(self, axis: str) -> list[float]:
        """Return time or nodes of every event, counted over all stages."""
        offset = self.nodes_before if axis == "n_nodes" else 0
        return [offset + getattr(event, axis) for event in self.events]


def _stages(events: Iterable[Event]) -> list[_Stage]:
    """Split a history into its stages."""
    stages: list[_Stage] = []
    nodes = 0
    for name, group in itertools.groupby(events, key=lambda event: event.stage):
        whole = list(group)
        stages.append(_Stage(name, _thinned(whole), nodes))
        nodes += max(event.n_nodes for event in whole)
    return stages


def _thinned(events: list[Event]) -> list[Event]:
    """Return at most `_MAX_EVENTS` events, the early ones more densely, since bounds change early."""
    if len(events) <= _MAX_EVENTS:
        return events
    kept = np.unique(np.geomspace(1, len(events), _MAX_EVENTS).round().astype(int)) - 1
    return [events[at] for at in kept]


def _history(result: Result, stages: list[_Stage], axis: str, label: str) -> go.Figure:
    """Draw the bounds of all stages, each in a separate band because the objectives differ."""
    fig = figure()
    for name, color in (("lower bound", LOWER), ("upper bound", UPPER)):
        points = _curve(stages, axis, name.replace(" ", "_"))
        x, y, words = ([point[at] for point in points] for at in range(3))
        fig.add_scatter(
            x=x,
            y=y,
            name=name,
            text=words,
            hovertemplate="%{text}<br>%{x}: %{y}<extra>" + name + "</extra>",
            mode="lines+markers",
            # if there are many, only the last one of each stage
            marker={"size": [6 if after is None or len(x) < 50 else 0 for after in [*x[1:], None]]},
            line={"color": color, "shape": "hv"},
        )
    began, whole = 0.0, max((stage.at(axis)[-1] for stage in stages), default=0.0)
    for number, stage in enumerate(stages):
        ended = stage.at(axis)[-1]
        fig.add_vrect(
            x0=began,
            x1=ended,
            fillcolor=GREY,
            opacity=0.08 if number % 2 else 0.16,
            line_width=0,
            layer="below",
            name=stage.name,
        )
        if ended - began >= _LABELLED * whole:  # the hover text of narrower ones names them
            fig.add_annotation(
                x=began, y=1.0, yref="paper", text=stage.name, showarrow=False,
                xanchor="left", yanchor="top", font={"size": 11},
            )  # fmt: skip
        began = ended
    fig.add_hline(
        y=result.upper_bound - result.gap_tol,
        line={"color": UPPER, "dash": "dot", "width": 1},
        name="upper bound - tolerance",
        showlegend=True,
    )
    fig.update_xaxes(title_text=label)
    fig.update_yaxes(title_text="squared units of the target", range=[0.0, _height(result, stages)])
    return fig


def _height(result: Result, stages: list[_Stage]) -> float:
    """Return twice the maximum final bound of a stage; initial poses can be far worse."""
    ends = [stage.events[-1].upper_bound for stage in stages]
    return 2.0 * max([result.upper_bound, *filter(math.isfinite, ends)])


def _curve(stages: list[_Stage], axis: str, bound: str) -> list[tuple[Any, Any, str]]:
    """Return the events with a finite bound and their stages, with a break between stages."""
    points: list[tuple[Any, Any, str]] = []
    for stage in stages:
        values = [getattr(event, bound) for event in stage.events]
        finite = [
            (float(f"{at:.7g}"), float(f"{value:.7g}"), stage.name)
            for at, value in zip(stage.at(axis), values, strict=True)
            if math.isfinite(value)
        ]
        points += [*finite, (None, None, "")] if finite else []
    return points
