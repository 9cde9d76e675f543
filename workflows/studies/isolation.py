"""The margin of the best pose: ``python -m workflows.studies.isolation OUT``.

Every problem is a shape of 100 points (``--points``) and a noisy copy in a random pose; all points are
matched. U is the objective of the best pose. `dcreg.alternatives` proves a lower bound L2 on the
objective of every pose that displaces the points by more than ``--isolated`` relative to the best pose.
The bound is *reached* if no other pose is listed and L2 exceeds both 1.5 U and the objective at an RMS
residual of ``--noise``. It is *false* if the best pose for the true pairs contradicts it.
Lengths are relative to the longest side of the shape. The study writes ``isolation.csv``, a row per
problem, and ``isolation_summary.csv``, a row per dimension and level of noise.
"""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

import dcreg
from data.contract import RawInstance
from data.registry import dataset
from dcreg.problem import Moments
from workflows.disturb import make_instance
from workflows.metrics import Case
from workflows.metrics.errors import SUCCESS_SHARE
from workflows.studies.answers import Question

SHAPES = (
    ("embedded", "fish"), ("embedded", "glyph"), ("lian_apm", "fu"), ("horse", "horse"), ("dino", "dino"),
    ("bunny", "bunny"), ("embedded", "pony"), ("embedded", "saurian"),
)  # fmt: skip
LEVELS = 0.0, 0.01, 0.02, 0.03
RATIO = 1.5  # of L2 to U


def main(
    out: Annotated[Path, typer.Argument(help="folder for the tables")],
    trials: Annotated[int, typer.Option(help="trials per shape and level")] = 3,
    limit: Annotated[float, typer.Option(help="seconds per problem")] = 10.0,
    points: Annotated[int, typer.Option(help="points per shape")] = 100,
    isolated: Annotated[float, typer.Option(help="displacement from the best pose")] = 0.15,
    noise: Annotated[float, typer.Option(help="RMS residual that the bound must exceed")] = 0.01,
    threads: Annotated[int, typer.Option(help="threads per problem")] = 1,
) -> None:
    """Prove the bounds; print and store the tables."""
    dcreg.warm_up()
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for trial, level, (name, shape) in itertools.product(range(trials), LEVELS, SHAPES):
        raw = make_instance(dataset(name), shape, "noise", level, trial, points)
        row = {"shape": shape, "dim": raw.source.shape[1], "level": level, "trial": trial}
        rows.append(row | bounded(raw, limit, isolated, noise, threads))
        pd.DataFrame(rows).to_csv(out / "isolation.csv", index=False)
    table = summary(pd.DataFrame(rows))
    table.to_csv(out / "isolation_summary.csv", index=False)
    print(table.to_string(index=False))


def bounded(
    raw: RawInstance, limit: float, isolated: float, noise: float, threads: int = 1
) -> dict[str, object]:
    """Return the lower bound for one problem, and whether it is reached or false."""
    asked, began = Question(raw, limit), time.process_time()
    found = dcreg.alternatives(
        *asked.clouds, n_inliers=asked.n_inliers, isolated=isolated, noise=noise, ratio=RATIO,
        time_limit=limit, options=dcreg.SolveOptions(threads=threads), **asked.keywords,
    )  # fmt: skip
    spent, result, planted = time.process_time() - began, found.result, asked.planted()
    judged = Case(
        result.T_target_source, raw.T_true, *asked.clouds, raw.pairs, len(raw.pairs), raw.scale_range
    )  # fmt: skip
    apart = Moments.of(raw.source).displacement(planted, result.T_certified)
    return {
        "right": judged.rmse_excess < SUCCESS_SHARE,
        "reached": found.is_unique,
        "false": apart > isolated * (1.0 + 1e-6) and asked.value() < found.lower_bound,
        "ratio": float("inf") if result.is_exact else found.lower_bound / result.upper_bound,
        "rms_proven": (found.lower_bound / result.n_inliers) ** 0.5,
        "cpu_s": round(spent, 2),
    }


def summary(problems: pd.DataFrame) -> pd.DataFrame:
    """Return a row per dimension and level: counts, and medians over the right answers."""
    right = problems[problems["right"]]
    grouped = right.groupby(["dim", "level"])
    table = grouped.agg(
        right=("right", "sum"),
        reached=("reached", "sum"),
        median_ratio=("ratio", "median"),
        least_ratio=("ratio", "min"),
        median_rms=("rms_proven", "median"),
        median_cpu_s=("cpu_s", "median"),
        max_cpu_s=("cpu_s", "max"),
    )
    counts = problems.groupby(["dim", "level"]).agg(
        problems=("right", "size"), false=("false", "sum")
    )
    return counts.join(table).reset_index()


if __name__ == "__main__":
    typer.run(main)
