"""How soon optima are proven: ``python -m workflows.studies.proof OUT``.

Every problem has 100 points (``--points``) before its disturbance. ``n_inliers`` is the number of true
pairs, or ``--share`` of it. The search continues to the time limit (``prove=True``). Poses are rigid in
3D; with ``--axis`` the axis of the rotation is known, which leaves four degrees of freedom. With
``--plane`` they are similarities of side views, which lack the axis of smallest extent. The study writes
``proof.csv``, a row per solve with the lower bound at several moments divided by the final upper bound,
and ``proof_summary.csv``, a row per test and level. Existing rows are kept, so an interrupted study can
be continued.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
import typer
from scipy.spatial.transform import Rotation

import dcreg
from data.contract import Dataset, PrototypeDataset, RawInstance
from data.registry import dataset
from dcreg.status import Status
from workflows.disturb import make_instance
from workflows.metrics import Case
from workflows.metrics.errors import SUCCESS_SHARE
from workflows.studies.modes import SHAPES, TESTS

MOMENTS_S = 3.0, 5.0, 10.0, 60.0
QUARTER = 0.24  # minimum L/U, lower divided by upper bound, of a useful bound: about a quarter


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
    plane: Annotated[bool, typer.Option(help="2D similarities of side views")] = False,
    axis: Annotated[bool, typer.Option(help="3D poses with a known axis of rotation")] = False,
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
        "plane": plane,
        "axis": axis,
    }
    if any({name: row.get(name) for name in settings} != settings for row in rows):
        raise typer.BadParameter(f"{path} was made with other settings; give another folder")
    done = {(row["shape"], row["test"], row["level"], row["trial"]) for row in rows}
    for cell in cells(trials, tests.split(","), shapes.split(",")):
        if tuple(cell) not in done:
            raw = cell.instance(points, plane)
            given = known_axis(raw, cell.trial) if axis else None
            found = _solved(raw, limit, threads, share, given)
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


def _solved(
    raw: RawInstance,
    limit: float,
    threads: int,
    share: float,
    pose_range: dcreg.PoseRange | None = None,
) -> dict[str, object]:
    began = time.perf_counter()
    is_2d, n_inliers = raw.source.shape[1] == 2, round(share * len(raw.pairs))
    result = dcreg.register(
        raw.source, raw.target, model="similarity2d" if is_2d else "rigid3d", n_inliers=n_inliers,
        scale_range=raw.scale_range if is_2d else None, time_limit=limit,
        pose_range=pose_range,
        options=dcreg.SolveOptions(mode=None if is_2d else "full", threads=threads, prove=True),
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
