"""How narrow the intervals of `dcreg.max_inliers` are: ``python -m workflows.studies.inliers OUT``.

Every problem is a shape of 100 points (``--points``) in 3D, or its side view in 2D, with outliers mixed
into both clouds, Gaussian noise on the target and a random pose. The distance is three standard
deviations of the noise. An interval is *closed* if both ends agree, and *wrong* if the pose of the true
pairs has more pairs than its upper end. The study writes ``inliers.csv``, a row per problem, and
``inliers_summary.csv``, a row per dimension and number of outliers.
"""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from scipy.spatial.distance import cdist

import dcreg
from dcreg.problem import apply_pose, largest_matching, scale_of
from workflows.disturb import seed_for
from workflows.studies.proof import Cell

SHAPES = "bunny", "horse"
NOISE = 0.01, 0.02, 0.03  # standard deviations, in longest sides of the shape
RATIOS = 0.1, 0.3, 0.5  # outliers in each cloud, per point of the shape
SIGMAS = 3.0  # the distance, in standard deviations


def main(
    out: Annotated[Path, typer.Argument(help="folder for the tables")],
    points: Annotated[int, typer.Option(help="points per shape")] = 100,
    trials: Annotated[int, typer.Option(help="trials per shape and level")] = 1,
    limit: Annotated[float, typer.Option(help="seconds per problem")] = 10.0,
) -> None:
    """Ask about all problems; print and store the tables."""
    dcreg.warm_up()
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for dim, noise, ratio, shape, trial in itertools.product(
        (2, 3), NOISE, RATIOS, SHAPES, range(trials)
    ):
        found = asked(Cell(shape, "mixed_outliers", ratio, trial), dim, noise, points, limit)
        rows.append({"dim": dim, "noise": noise, "ratio": ratio, "shape": shape} | found)
        pd.DataFrame(rows).to_csv(out / "inliers.csv", index=False)
        print(pd.DataFrame(rows[-1:]).to_string(index=False, header=len(rows) == 1), flush=True)
    table = summary(pd.DataFrame(rows))
    table.to_csv(out / "inliers_summary.csv", index=False)
    print(table.to_string(index=False))


def asked(cell: Cell, dim: int, noise: float, points: int, limit: float) -> dict[str, object]:
    """Return the interval for one problem, and the number of pairs at the pose of the true pairs."""
    raw = cell.instance(points, plane=dim == 2, base_deformation=0.0)
    sigma = noise * scale_of(raw.T_true)
    rng = np.random.default_rng(seed_for("inliers", *cell, dim, noise))
    target = raw.target + sigma * rng.standard_normal(raw.target.shape)
    distance = SIGMAS * sigma
    began = time.process_time()
    found = dcreg.max_inliers(
        raw.source, target, distance=distance, time_limit=limit, scale_range=raw.scale_range,
        model="similarity2d" if dim == 2 else "rigid3d",
    )  # fmt: skip
    cpu_s = time.process_time() - began
    near = cdist(apply_pose(raw.T_true, raw.source), target) <= distance * (1.0 - 1e-9)
    planted = int((largest_matching(near) >= 0).sum())
    return {
        "planted": planted,
        "at_least": found.at_least,
        "at_most": found.at_most,
        "n_possible": found.n_possible,
        "closed": found.is_exact,
        "wrong": planted > found.at_most,
        "time_s": round(found.time_s, 2),
        "cpu_s": round(cpu_s, 2),
    }


def summary(answers: pd.DataFrame) -> pd.DataFrame:
    """Return a row per dimension and share of outliers."""
    answers = answers.assign(width=answers["at_most"] - answers["at_least"])
    grouped = answers.groupby(["dim", "ratio"], sort=False)
    return grouped.agg(
        problems=("closed", "size"),
        closed=("closed", "sum"),
        wrong=("wrong", "sum"),
        median_width=("width", "median"),
        largest_width=("width", "max"),
        median_s=("time_s", "median"),
        median_cpu_s=("cpu_s", "median"),
    ).reset_index()


if __name__ == "__main__":
    typer.run(main)
