"""A page that shows how the search of a run divides its boxes: ``python -m reports boxes RUN``."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from dcreg.search import Boxes, Recorder, recording
from dcreg.search.recording import Recording
from reports import templating, theme
from reports.page import pack_json
from reports.tables import ReportError
from workflows.labels import display_names
from workflows.replay import Repetition

MOST_DRAWN = 20_000  # boxes of a slice; if there are more, the first ones
ENDS = 400  # rounds whose bounds the page states
# Names of parameters, by their number: similarities in 2D, translations, rigid poses, rotations.
_SHIFT = ("t_x", "t_y", "t_z")
_TURN = ("q_w", "q_x", "q_y", "q_z")
NAMES = {
    ("similarity2d", 4): ("s cos α", "s sin α", "t_x", "t_y"),
    ("rigid3d", 3): _SHIFT,
    ("rigid3d", 4): _TURN,
    ("rigid3d", 7): (*_TURN, *_SHIFT),
}


def repeat(run_id: str, experiment: str, results: Path, out: Path) -> tuple[Path, dict[str, Any]]:
    """Repeat a run, write the page of its boxes to the folder `out`; return its path and the result.

    Raises
    ------
    ReportError
        The method does not search with `dcreg.search`.
    UserError
        As `workflows.replay.replay`.
    """
    repetition = Repetition.of(run_id, experiment, results)
    repetition.method.warm_up(repetition.instance)  # its search is not recorded
    with recording() as recorder:
        result = repetition.result()
    if not recorder.stages:
        raise ReportError(
            f"{run_id}: {repetition.run.method.name} does not search with dcreg.search; choose a run "
            "of DC-Reg"
        )
    page = out / f"{run_id}.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    names = display_names(repetition.plan.experiment.methods)
    shown = {**result, "method": names[repetition.run.method.name]}
    page.write_text(_render(run_id, shown, recorder, repetition.instance.model), encoding="utf-8")
    return page, result


def _render(run_id: str, result: dict[str, Any], recorder: Recorder, model: str) -> str:
    stages = [stage_of(name, each, model) for name, each in recorder.stages.items()]
    return (
        templating.environment()
        .get_template("boxes.html")
        .render(
            run=run_id,
            result=result,
            stages=stages,
            is_complete=recorder.is_complete,
            variables=theme.css_variables([]),
            script=templating.script("boxes.js"),
            data=pack_json(stages),
        )
    )


def stage_of(name: str, recorded: Recording, model: str) -> dict[str, Any]:
    """Return what the page shows of a stage: slices through the last incumbent, and bounds per round."""
    boxes, is_open = _together(recorded)
    theta = recorded.ends[-1][2]
    names = NAMES.get((model, len(theta)), tuple(f"θ{at + 1}" for at in range(len(theta))))
    pairs = list(itertools.combinations(range(len(theta)), 2))
    excluded = _excluded(boxes, recorded)
    slices = [
        found for pair in pairs if (found := _slice(boxes, is_open, excluded, theta, pair, names))
    ]
    counts = np.cumsum([len(each) for each, _ in recorded.rounds])
    shown = np.unique(np.linspace(0, len(counts) - 1, ENDS).round().astype(int))
    return {
        "name": name,
        "count": len(boxes),
        "slices": slices,
        "ends": [[int(counts[at]), *recorded.ends[at][:2]] for at in shown],
        "upper": recorded.ends[-1][1],
    }


def _together(recorded: Recording) -> tuple[Boxes, np.ndarray]:
    parts = [boxes for boxes, _ in recorded.rounds]
    return Boxes(
        np.concatenate([part.lower for part in parts]),
        np.concatenate([part.upper for part in parts]),
        np.concatenate([part.bounds for part in parts]),
    ), np.concatenate([is_open for _, is_open in recorded.rounds])


def _excluded(boxes: Boxes, recorded: Recording) -> np.ndarray:
    """Return after how many boxes a cover excluded each box; 0 if none did."""
    after = np.zeros(len(boxes), int)
    numbered = Boxes(boxes.lower, boxes.upper, np.arange(len(boxes), dtype=float))
    for count, confined in recorded.cuts:
        kept = confined.meeting(numbered).bounds.astype(int)
        after[np.setdiff1d(np.flatnonzero(after == 0), kept)] = max(1, count)
    return after


def _slice(
    boxes: Boxes,
    is_open: np.ndarray,
    excluded: np.ndarray,
    theta: np.ndarray,
    pair: tuple[int, int],
    names: tuple[str, ...],
) -> dict[str, Any] | None:
    """Return the boxes that meet the plane of two parameters through `theta`; None if it is a line."""
    near = 1e-9 * max(1.0, float(np.abs(theta).max()))
    inside = (boxes.lower <= theta + near) & (boxes.upper >= theta - near)
    inside[:, pair] = True
    rows = np.flatnonzero(inside.all(axis=1))
    sides = (boxes.upper - boxes.lower)[rows][:, pair]
    if not len(rows) or (sides.max(axis=0) <= 0.0).any():
        return None
    rows = rows[:MOST_DRAWN]
    corners = [each[rows][:, axis] for axis in pair for each in (boxes.lower, boxes.upper)]
    return {
        "axes": [names[axis] for axis in pair],
        "at": [float(theta[axis]) for axis in pair],
        "boxes": [corner.tolist() for corner in corners],
        "order": (rows + 1).tolist(),
        "bounds": np.where(np.isfinite(boxes.bounds[rows]), boxes.bounds[rows], -1.0).tolist(),
        "open": is_open[rows].astype(int).tolist(),
        "excluded": excluded[rows].tolist(),
    }
