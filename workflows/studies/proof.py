"""How soon optima are proven: ``python -m workflows.studies.proof OUT``.

Every problem has 100 points (``--points``) before its disturbance. ``n_inliers`` is the number of true
pairs, or ``--share`` of it. The search continues to the time limit (``prove=True``). ``--poses`` are
rigid in 3D by default; with ``axis`` the axis of the rotation is known, which leaves four degrees of
freedom; with ``scaled`` they are similarities in 3D, and each target has another scale; with ``plane``
they are similarities of side views, which lack the axis of smallest extent. The study writes
``proof.csv``, a row per solve with the lower bound at several moments divided by the final upper bound,
and ``proof_summary.csv``, a row per test and level. Existing rows are kept, so an interrupted study can
be continued.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
import typer
from scipy.spatial.transform import Rotation

import dcreg
from data.contract import Dataset, PrototypeDataset, RawInstance
from data.registry import dataset
from dcreg.problem.problem import DEFAULT_SCALE_RANGE
from dcreg.status import Status
from workflows.disturb import make_instance
from workflows.metrics import Case
from workflows.metrics.errors import SUCCESS_SHARE
from workflows.studies.modes import SHAPES, TESTS

MOMENTS_S = 3.0, 5.0, 10.0, 60.0
QUARTER = 0.24  # minimum L/U, lower divided by upper bound, of a useful bound: about a quarter


class Poses(StrEnum):
    """What poses the problems have."""

    RIGID = "rigid"
    AXIS = "axis"
    SCALED = "scaled"
    PLANE = "plane"


MODELS = {Poses.PLANE: "similarity2d", Poses.SCALED: "similarity3d"}  # otherwise rigid3d


class Cell(NamedTuple):
    """One problem of the study."""

    shape: str
    test: str
    level: float
    trial: int

    def instance(self, points: int, plane: bool, **options: Any) -> RawInstance:
        source = dataset(self.shape)
        shape = SHAPES.get(self.shape) or source.shapes()[0]
        source = SideView(source) if plane else source
        return make_instance(source, shape, self.test, self.level, self.trial, points, **options)


class SideView(PrototypeDataset):
    """The shapes of a 3D dataset without the axis of their smallest extent."""

    def __init__(self, solid: Dataset) -> None:
        assert isinstance(solid, PrototypeDataset)
        super().__init__(solid.card)
        self.solid = solid

    def shapes(self) -> list[str]:
        return self.solid.shapes()

    def fetch(self, shape: str, test: str = "", level: float = 0.0, trial: int = 0) -> list[Path]:
        return self.solid.fetch(shape, test, level, trial)

    def points(self, shape: str, n_points: int | None = None) -> np.ndarray:
        points = self.solid.points(shape, n_points)
        return np.delete(points, np.ptp(points, axis=0).argmin(), axis=1)


def main(
    out: Annotated[Path, typer.Argument(help="folder for the tables")],
    trials: Annotated[int, typer.Option(help="trials per shape, test and level")] = 5,
    limit: Annotated[float, typer.Option(help="seconds per solve")] = 60.0,
    threads: Annotated[int, typer.Option(help="threads per solve")] = 2,
    points: Annotated[int, typer.Option(help="points per shape")] = 100,
    tests: Annotated[str, typer.Option(help="tests, comma-separated")] = ",".join(TESTS),
    shapes: Annotated[str, typer.Option(help="datasets, comma-separated")] = ",".join(SHAPES),
    share: Annotated[float, typer.Option(help="n_inliers over true pairs")] = 1.0,
    poses: Annotated[Poses, typer.Option(help="kind of poses")] = Poses.RIGID,
) -> None:
    """Solve the problems; print and store the tables."""
    dcreg.warm_up()
    out.mkdir(parents=True, exist_ok=True)
    path = out / "proof.csv"
    rows: list[dict[Any, Any]] = []
    if path.exists():
        rows = pd.read_csv(path).to_dict("records")
    settings = {
        "points": points,
        "limit_s": limit,
        "threads": threads,
        "share": share,
        "poses": poses.value,
    }
    if any({name: row.get(name) for name in settings} != settings for row in rows):
        raise typer.BadParameter(f"{path} was made with other settings; give another folder")
    done = {(row["shape"], row["test"], row["level"], row["trial"]) for row in rows}
    for cell in cells(trials, tests.split(","), shapes.split(",")):
        if tuple(cell) not in done:
            raw = cell.instance(points, poses is Poses.PLANE)
            raw = scaled(raw, cell.trial) if poses is Poses.SCALED else raw
            given = known_axis(raw, cell.trial) if poses is Poses.AXIS else None
            found = _solved(raw, MODELS.get(poses, "rigid3d"), limit, threads, share, given)
            rows.append(cell._asdict() | settings | found)
            pd.DataFrame(rows).to_csv(path, index=False)
    table = summary(pd.DataFrame(rows))
    table.to_csv(out / "proof_summary.csv", index=False)
    print(table.to_string(index=False))


def summary(solves: pd.DataFrame) -> pd.DataFrame:
    """Return the shares of proven optima and of useful bounds, a row per test and level."""
    moments = [s for s in MOMENTS_S if f"ratio_{s:g}" in solves]
    rows = []
    for (test, level), group in solves.groupby(["test", "level"], sort=False):
        row = {"test": test, "level": level, "solves": len(group), "right": group["right"].mean()}
        for s in moments:
            ratio = group[f"ratio_{s:g}"]
            row |= {
                f"optimal {s:g} s": (group["proved_s"] <= s).mean(),
                f"L/U >= {QUARTER} {s:g} s": (ratio >= QUARTER).mean(),
                f"median L/U {s:g} s": ratio.median(),
            }
        rows.append(row)
    return pd.DataFrame(rows)


def cells(trials: int, tests: list[str], shapes: list[str]) -> Iterator[Cell]:
    for trial, test in itertools.product(range(trials), tests):
        for level, shape in itertools.product(TESTS[test], shapes):
            yield Cell(shape, test, level, trial)


def known_axis(raw: RawInstance, seed: int) -> dcreg.PoseRange:
    """Return the range of poses that differ from the true one by a rotation about a random axis.

    Its reference pose is turned about the axis by a random angle, and knows no translation.
    """
    rng = np.random.default_rng([5, seed])
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    around = np.eye(4)
    turn = Rotation.from_rotvec(rng.uniform(0.0, 2.0 * np.pi) * axis).as_matrix()
    around[:3, :3] = turn @ raw.T_true[:3, :3]
    return dcreg.PoseRange(axis=axis, around=around)


def scaled(raw: RawInstance, seed: int) -> RawInstance:
    """Return the problem with its target scaled by a random factor."""
    factor = np.random.default_rng([6, seed]).uniform(0.7, 1.4)
    pose = np.diag([factor, factor, factor, 1.0]) @ raw.T_true
    return replace(
        raw,
        target=factor * raw.target,
        T_true=pose,
        scale_range=DEFAULT_SCALE_RANGE["similarity3d"],
    )


def _solved(
    raw: RawInstance,
    model: str,
    limit: float,
    threads: int,
    share: float,
    pose_range: dcreg.PoseRange | None = None,
) -> dict[str, object]:
    began = time.perf_counter()
    mode = "full" if raw.source.shape[1] == 3 else None
    result = dcreg.register(
        raw.source, raw.target, model=model, n_inliers=round(share * len(raw.pairs)),
        scale_range=None if model == "rigid3d" else raw.scale_range, time_limit=limit,
        pose_range=pose_range,
        options=dcreg.SolveOptions(mode=mode, threads=threads, prove=True),
    )  # fmt: skip
    spent = time.perf_counter() - began - result.time_setup_s
    ratios = {f"ratio_{s:g}": _ratio_at(result, s) for s in MOMENTS_S if s <= limit}
    judged = Case(
        result.T_target_source, raw.T_true, raw.source, raw.target, raw.pairs, len(raw.pairs),
        raw.scale_range,
    )  # fmt: skip
    return {
        "status": result.status.value,
        "right": judged.rmse_excess < SUCCESS_SHARE,
        "time_s": spent,
        "proved_s": spent if result.status is Status.OPTIMAL else np.inf,
        "n_nodes": result.n_nodes,
        **ratios,
    }


def _ratio_at(result: dcreg.Result, moment_s: float) -> float:
    """Return the lower bound at a moment divided by the final upper bound."""
    lower = [event.lower_bound for event in result.trace if event.time_s <= moment_s]
    return max(lower, default=0.0) / result.upper_bound if result.upper_bound else 1.0


if __name__ == "__main__":
    typer.run(main)
