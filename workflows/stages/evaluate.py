"""From raw results and ground truth to metrics: pure, cheap, and repeatable without any new run."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from baselines import registry as methods
from data import registry
from data.contract import PrototypeDataset
from dcreg.problem import scale_of
from workflows import records
from workflows.instances import Problem, Truth, read_problems, read_truths
from workflows.metrics import BROKEN, METRICS, Case, Metric

# Columns of raw results that `judge` needs.
JUDGED = [
    "run_id", "instance_id", "n_source", "n_target", "n_inliers", "T_target_source", "lower_bound",
    "certificate_scope",
]  # fmt: skip


def evaluate(folder: Path, plan_path: Path) -> pd.DataFrame:
    """Return one row of metrics for every planned run, from the instances and runs in `folder`."""
    for origin, reason in BROKEN.items():
        _report(f"{origin} is left out: {reason}")
    plan = records.read(plan_path, records.PLAN)
    options = {
        row["method"]: methods.read_card(row["baseline"]).parameters | json.loads(row["options"])
        for row in plan.drop_duplicates("method").to_dict("records")
    }
    limits = {dataset: success_limits(dataset) for dataset in plan["dataset"].unique()}
    normalised = {dataset for dataset in limits if is_normalised(dataset)}
    tables = []
    for chunk_id, planned in plan.groupby("chunk_id", sort=False):
        problems = {p.instance_id: p for p in read_problems(folder / f"instances/{chunk_id}.npz")}
        truths = read_truths(folder / f"truth/{chunk_id}.npz")
        datasets = dict(zip(planned["instance_id"], planned["dataset"], strict=True))
        rows = [
            judge(run, problems[key], truths[key], limits[at], options[method], at in normalised)
            for method in planned["method"].unique()
            for run in _raw(folder / f"runs/{method}/{chunk_id}.parquet")
            if (key := run["instance_id"]) in datasets and (at := datasets[key])
        ]
        tables.append(pd.DataFrame(rows))
    return relate(pd.concat(tables, ignore_index=True))


def _raw(path: Path) -> list[dict[str, Any]]:
    """Return what `judge` needs of the results of a job; absent numbers are NaN."""
    import polars as pl

    numbers = pl.col(pl.Float64).fill_null(np.nan)
    return records.scan([path], JUDGED).with_columns(numbers).collect().to_dicts()


def success_limits(dataset: str) -> dict[str, float]:
    """Return the limits of errors of a successful pose that the card of a dataset states, by metric."""
    found = registry.datasets()
    return found[dataset].card.success_limits if dataset in found else {}


def is_normalised(dataset: str) -> bool:
    """Tell whether the shapes of a dataset have the longest side 1."""
    return isinstance(registry.datasets().get(dataset), PrototypeDataset)


def judge(
    run: Mapping[Any, Any],
    problem: Problem,
    truth: Truth,
    limits: Mapping[str, float] | None = None,
    options: Mapping[str, Any] | None = None,
    normalised: bool = False,
) -> dict[str, Any]:
    """Return the metrics of one run; without a pose they are empty, and those of yes or no are no.

    `options` are all options of the method, defaults included. The shape of a `normalised` dataset has
    the longest side 1 before the reference pose.
    """
    row: dict[str, Any] = {
        "run_id": run["run_id"],
        "instance_id": run["instance_id"],
        "n_inliers": run["n_inliers"],
        "n_inliers_true": len(truth.pairs),
        "dim": problem.source.shape[1],
        "noise_bound": problem.noise_bound,
        "T_reference": json.dumps(truth.T_true.tolist()),
    }
    found = json.loads(run["T_target_source"]) if run["T_target_source"] else None
    case = Case(
        T=np.array(truth.T_true if found is None else found),
        T_true=truth.T_true,
        source=problem.source,
        target=problem.target,
        pairs=truth.pairs,
        marks=truth.marks,
        n_inliers=run["n_inliers"],
        scale_range=problem.scale_range,
        success_limits=limits or {},
        lower_bound=run["lower_bound"],
        scope=run["certificate_scope"],
        is_downsampled=(run["n_source"], run["n_target"])
        != (len(problem.source), len(problem.target)),
        truth_in_cube=truth_in_cube(run, problem, truth, options or {}),
        shape_length=scale_of(truth.T_true) if normalised else None,
    )
    for name, metric in METRICS.items():
        # Metrics of the ground truth alone also have a value where the method found no pose.
        known = found is not None or metric.better == "none"
        row[name] = _value(name, metric, case) if known else np.nan
        if metric.unit == "yes/no":
            row[name] = found is not None and bool(row[name])
    return row


def _value(name: str, metric: Metric, case: Case) -> float:
    """Compute a metric; if one of another package fails, its value is empty."""
    if metric.compute is None:
        return np.nan
    try:
        return metric.compute(case)
    except Exception as error:
        if not metric.is_added:
            raise
        _report(f"metric {name} of {metric.module} is left empty: {type(error).__name__}: {error}")
        return np.nan


@cache
def _report(problem: str) -> None:
    """Print a problem once."""
    print(f"warning: {problem}", file=sys.stderr, flush=True)


def truth_in_cube(
    run: Mapping[Any, Any], problem: Problem, truth: Truth, options: Mapping[str, Any]
) -> float:
    """Return 1 or 0 for a method that searches a cube of translations, NaN for all others."""
    is_searched = "translation_half_width" in options and problem.model == "rigid3d"
    if not is_searched or not run["n_source"]:
        return np.nan
    from baselines.goicp.adapter import contains_translation  # loads Numba

    n_points = int(max(run["n_source"], run["n_target"]))
    is_whole = n_points >= max(len(problem.source), len(problem.target))
    given = problem.for_solver(1.0, 0, None if is_whole else n_points)
    given = replace(given, n_inliers=int(run["n_inliers"]))
    half = options["translation_half_width"]
    return float(contains_translation(given, truth.T_true, half, options.get("normalise", True)))


def relate(metrics: pd.DataFrame) -> pd.DataFrame:
    """Add the metrics that compare a run with the others on its instance and n_inliers."""
    attained = metrics["objective"].where(metrics["admissible"])
    alike = attained.groupby([metrics["instance_id"], metrics["n_inliers"]])
    best = np.fmin(alike.transform("min"), metrics["objective_true"])
    return metrics.assign(objective_best=best, objective_regret=attained - best)
