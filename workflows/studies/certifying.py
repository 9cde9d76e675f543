"""CPU time of `certify` relative to `register`: ``python -m workflows.studies.certifying OUT``.

The problems are those of `workflows.studies.proof`: rigid poses in 3D or, with ``--plane``, similarities
of side views in 2D. ``n_inliers`` is the number of true pairs. Three poses are judged:

``true``
    the best pose for the true pairs;
``perturbed``
    this pose, turned by 2 degrees and moved by 2 % of the extent of the source;
``wrong``
    this pose, turned by 120 degrees and moved by half of the extent.

A round solves the problem and calls `certify` for each pose, with one thread; every second round has the
reverse order. Times are CPU times. The minima over the rounds are compared, because other work on the
machine can only increase the times. The study writes ``certifying.csv``, a row per problem and pose: the
ratio of the minimum times, the range of the ratio over the rounds, and the ratio of the numbers of boxes.
It omits problems that are not proven within the limit or are solved in less than ``--least`` seconds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

import dcreg
from data.contract import RawInstance
from dcreg.problem import apply_pose
from dcreg.status import Status
from workflows.studies.answers import Question
from workflows.studies.modes import SHAPES, TESTS
from workflows.studies.proof import cells

# angle in degrees, and displacement of the centroid in extents of the source
POSES = {"true": (0.0, 0.0), "perturbed": (2.0, 0.02), "wrong": (120.0, 0.5)}


def main(
    out: Annotated[Path, typer.Argument(help="folder for the table")],
    points: Annotated[int, typer.Option(help="points per shape")] = 80,
    rounds: Annotated[int, typer.Option(help="solves of each problem")] = 3,
    limit: Annotated[float, typer.Option(help="seconds per solve")] = 60.0,
    least: Annotated[float, typer.Option(help="CPU seconds; omit faster solves")] = 0.3,
    tests: Annotated[str, typer.Option(help="tests, comma-separated")] = ",".join(TESTS),
    shapes: Annotated[str, typer.Option(help="datasets, comma-separated")] = ",".join(SHAPES),
    plane: Annotated[bool, typer.Option(help="2D similarities of side views")] = False,
) -> None:
    """Solve and judge; print and store the table."""
    dcreg.warm_up()
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    for cell in cells(1, tests.split(","), shapes.split(",")):
        found = compared(cell.instance(points, plane), rounds, limit, least)
        rows += [{**cell._asdict(), **row} for row in found]
        if found:
            pd.DataFrame(rows).to_csv(out / "certifying.csv", index=False)
            print(pd.DataFrame(rows[-len(found) :]).to_string(index=False), flush=True)
    if rows:
        print(summary(pd.DataFrame(rows)).to_string(index=False))


def compared(raw: RawInstance, rounds: int, limit: float, least: float) -> list[dict[str, object]]:
    """Return a row per pose; none if the problem is not proven or is solved too fast."""
    question = Question(raw, limit)
    given: dict[str, Any] = {
        **question.keywords, "n_inliers": question.n_inliers, "time_limit": limit,
        "options": dcreg.SolveOptions(mode=None if raw.source.shape[1] == 2 else "full",
                                      threads=1, prove=True),
    }  # fmt: skip
    best = question.planted()
    poses = {name: _moved(best, raw.source, *change) for name, change in POSES.items()}
    spent: dict[str, list[float]] = {name: [] for name in ("solve", *poses)}
    verdicts, boxes = {}, {}
    for number in range(rounds):
        for name in list(spent)[:: -1 if number % 2 else 1]:
            if name == "solve":
                seconds, result = _timed(lambda: dcreg.register(*question.clouds, **given))
            else:
                pose = poses[name]
                seconds, judged = _timed(lambda: dcreg.certify(*question.clouds, pose, **given))  # noqa: B023
                verdicts[name], result = judged.verdict, judged.result
            if result.status is not Status.OPTIMAL or (name == "solve" and seconds < least):
                return []
            spent[name].append(seconds)
            boxes[name] = result.n_nodes
    solve = np.array(spent["solve"])
    found = []
    for name in poses:
        judged_s = np.array(spent[name])
        found.append({
            "pose": name, "verdict": verdicts[name], "solve_s": float(solve.min()),
            "ratio": float(judged_s.min() / solve.min()), "least": float((judged_s / solve).min()),
            "most": float((judged_s / solve).max()), "boxes": boxes[name] / max(boxes["solve"], 1),
        })  # fmt: skip
    return found


def _timed(ask: Callable[[], Any]) -> tuple[float, Any]:
    """Return the CPU time of a call, and what it returns."""
    began = time.process_time()
    found = ask()
    return time.process_time() - began, found


def _moved(T: np.ndarray, source: np.ndarray, angle_deg: float, share: float) -> np.ndarray:
    """Return a pose after a turn about the moved centroid and a shift, along the first axes."""
    angle, d = np.radians(angle_deg), source.shape[1]
    turn = np.eye(d)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    centre = apply_pose(T, source.mean(axis=0)[None])[0]
    moved = T.copy()
    moved[:d, :d] = turn @ T[:d, :d]
    moved[:d, d] = centre - moved[:d, :d] @ source.mean(axis=0)
    moved[0, d] += share * float(np.ptp(source, axis=0).max())
    return moved


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row per pose: the number of problems, and the ratios of times and of boxes."""
    return (
        rows.groupby("pose", sort=False)
        .agg(
            problems=("ratio", "size"),
            solve_s=("solve_s", "median"),
            ratio=("ratio", "median"),
            highest=("ratio", "max"),
            most_boxes=("boxes", "max"),
        )
        .reset_index()
    )


if __name__ == "__main__":
    typer.run(main)
