"""How many questions are answered: ``python -m workflows.studies.answers OUT``.

The problems are the embedded shapes with the disturbances of `workflows.studies.modes`. The planted pose
is the best one for the true pairs. Four questions are asked about each problem:

``certify``
    Is the planted pose optimal?
``alternatives``
    Is the best pose the only one?
``max_inliers``
    How many pairs are within a twentieth of the longest side?
``axis``
    In 3D: which pose is best if the axis of the rotation is known (four degrees of freedom)?

An answer is *closed* if it is decided, *open* if not, and *wrong* if the planted pose contradicts it. A
closed answer that this pose does not contradict need not be true. The study writes ``answers.csv``, a row
per answer, and ``answers_summary.csv``, a row per question.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer
from scipy.spatial.distance import cdist

import dcreg
from data.contract import RawInstance
from data.registry import dataset
from dcreg.problem import Moments, PoseRange, Problem, apply_pose, exact_objective, largest_matching
from dcreg.status import Status
from workflows.disturb import make_instance
from workflows.studies.modes import TESTS
from workflows.studies.proof import known_axis

DISTANCE = 0.05  # of pairs in `max_inliers`, in longest sides of the shape
DATASET = "embedded"


@dataclass(frozen=True)
class Question:
    """A problem with its planted pose."""

    raw: RawInstance
    limit: float
    pose_range: PoseRange | None = None

    @property
    def keywords(self) -> dict[str, Any]:
        """The model, the scales and limits."""
        is_2d = self.raw.source.shape[1] == 2
        given: dict[str, Any] = {
            "model": "similarity2d" if is_2d else "rigid3d",
            "scale_range": self.raw.scale_range if is_2d else None,
        }
        return given | ({} if self.pose_range is None else {"pose_range": self.pose_range})

    @property
    def clouds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.raw.source, self.raw.target

    @property
    def n_inliers(self) -> int:
        return len(self.raw.pairs)

    def planted(self) -> np.ndarray:
        """Return the best admissible pose for the true pairs."""
        rows, columns = self.raw.pairs.T
        problem = Problem(*self.clouds, self.n_inliers, **self.keywords)
        return problem.fit(self.raw.source[rows], self.raw.target[columns])

    def value(self) -> float:
        """Return the objective of the planted pose, and the rounding error with it."""
        value, _ = dcreg.objective(*self.clouds, self.planted(), self.n_inliers)
        return value + exact_objective(*self.clouds, self.n_inliers)


# whether the answer is closed, and whether the planted pose contradicts it
Answer = tuple[bool, bool]


def certify(question: Question) -> Answer:
    """Ask about the planted pose; it contradicts a lower bound above its objective."""
    found = dcreg.certify(
        *question.clouds, question.planted(), n_inliers=question.n_inliers, time_limit=question.limit,
        **question.keywords,
    )  # fmt: skip
    return found.verdict != "open", found.lower_bound > question.value()


def alternatives(question: Question) -> Answer:
    """Ask for all poses; the planted one contradicts a complete list that lacks it."""
    found = dcreg.alternatives(
        *question.clouds,
        n_inliers=question.n_inliers,
        time_limit=question.limit,
        **question.keywords,
    )
    moments, T = Moments.of(question.raw.source), question.planted()
    apart = min(moments.displacement(T, other) for other in found.poses.values())
    value = question.value()
    is_distinct = apart > found.min_displacement * (1.0 + 1e-6)
    is_missing = found.is_complete and value < found.threshold
    return found.is_complete, is_distinct and (is_missing or found.lower_bound > value)


def max_inliers(question: Question) -> Answer:
    """Ask for the largest number; the planted pose contradicts a smaller one than its own."""
    found = dcreg.max_inliers(
        *question.clouds, distance=DISTANCE, time_limit=question.limit, **question.keywords
    )
    near = cdist(apply_pose(question.planted(), question.raw.source), question.raw.target)
    reached = int((largest_matching(near <= DISTANCE * (1.0 - 1e-9)) >= 0).sum())
    return found.is_exact, reached > found.at_most


def best_of_axis(question: Question) -> Answer:
    """Ask for the best pose of a known axis; the planted one contradicts a higher lower bound."""
    found = dcreg.register(
        *question.clouds, n_inliers=question.n_inliers, time_limit=question.limit,
        options=dcreg.SolveOptions(prove=True), **question.keywords,
    )  # fmt: skip
    return found.status is Status.OPTIMAL, found.lower_bound > question.value()


QUESTIONS: dict[str, Callable[[Question], Answer]] = {
    "certify": certify,
    "alternatives": alternatives,
    "max_inliers": max_inliers,
    "axis": best_of_axis,
}


def main(
    out: Annotated[Path, typer.Argument(help="folder for the tables")],
    points: Annotated[int, typer.Option(help="points per shape")] = 40,
    trials: Annotated[int, typer.Option(help="trials per shape, test and level")] = 1,
    limit: Annotated[float, typer.Option(help="seconds per question")] = 5.0,
    tests: Annotated[str, typer.Option(help="tests, comma-separated")] = ",".join(TESTS),
) -> None:
    """Ask all questions; print and store the tables."""
    dcreg.warm_up()
    out.mkdir(parents=True, exist_ok=True)
    answers = pd.DataFrame(rows(points, trials, limit, tests.split(",")))
    answers.to_csv(out / "answers.csv", index=False)
    table = summary(answers)
    table.to_csv(out / "answers_summary.csv", index=False)
    print(table.to_string(index=False))
    print(f"tables: {out}")


def rows(points: int, trials: int, limit: float, tests: list[str]) -> Iterator[dict[str, object]]:
    """Yield a row per answer."""
    source = dataset(DATASET)
    cells = (
        (shape, test, level, trial)
        for shape in source.shapes()
        for test in tests
        for level in TESTS[test]
        for trial in range(trials)
    )
    for shape, test, level, trial in cells:
        raw = make_instance(source, shape, test, level, trial, points)
        for name, ask in QUESTIONS.items():
            if name == "axis" and raw.source.shape[1] == 2:
                continue
            pose_range = known_axis(raw, trial) if name == "axis" else None
            began = time.perf_counter()
            is_closed, is_wrong = ask(Question(raw, limit, pose_range))
            yield {
                "question": name, "shape": shape, "test": test, "level": level, "trial": trial,
                "n_inliers": len(raw.pairs), "closed": is_closed, "wrong": is_wrong,
                "time_s": round(time.perf_counter() - began, 2),
            }  # fmt: skip


def summary(answers: pd.DataFrame) -> pd.DataFrame:
    """Return a row per question: numbers of answers, and the median time."""
    grouped = answers.assign(open=~answers["closed"]).groupby("question", sort=False)
    return grouped.agg(
        problems=("closed", "size"),
        closed=("closed", "sum"),
        open=("open", "sum"),
        wrong=("wrong", "sum"),
        median_s=("time_s", "median"),
    ).reset_index()


if __name__ == "__main__":
    typer.run(main)
