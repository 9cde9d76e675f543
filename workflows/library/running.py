"""Run a registered method on the problems: ``python -m workflows.library run METHOD``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import dcreg
from baselines import registry
from baselines.contract import Instance
from data.contract import DataError, RawInstance
from data.library.evaluate import admissible, evaluate
from data.library.problem import LibraryError, Problem
from data.library.record import read_record
from dcreg.assignment.descent import polish
from dcreg.names import DEFAULT_REL_GAP, POSE_SCOPES
from dcreg.status import Status
from workflows.config import LimitSettings, MethodSettings
from workflows.stages.generate import noise_bound
from workflows.stages.sandbox import Sandbox
from workflows.stages.worker import CROSSED, LATE

RUNS = Path("results") / "library" / "runs"
PROFILE_S = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 60.0)
RIGHT_GAP = 1.0 + DEFAULT_REL_GAP


def run_method(name: str, problems: Sequence[Problem], limit_s: float, folder: Path = RUNS) -> Path:
    """Run a method on problems, print its table and write it as CSV.

    Returns
    -------
    Path of the table.
    """
    registry.read_card(name)
    folder.mkdir(parents=True, exist_ok=True)
    out = folder / f"{name}.csv"
    method = MethodSettings(name=name, baseline=name)
    with Sandbox(method, LimitSettings(time_s=limit_s), folder / f"{name}.log") as sandbox:
        table = pd.DataFrame(list(_runs(sandbox, problems)))
    table.to_csv(out, index=False)
    print(summary(name, table, limit_s))
    print(f"table     {out}")
    return out


def _runs(sandbox: Sandbox, problems: Sequence[Problem]) -> Iterator[dict[str, Any]]:
    for problem in problems:
        try:
            instance = instance_of(problem)
        except DataError as error:
            print(f"{problem.id}: skipped: {error}", flush=True)
            continue
        row = judged(problem, sandbox.solve(instance))
        print(f"{problem.id}: {row['verdict']}, {row['time_s']:.2f} s {row['note']}", flush=True)
        yield row


def instance_of(problem: Problem) -> Instance:
    """Return the problem as a method receives it, without poses and pairs."""
    source, target = problem.clouds
    assert problem.truth is not None
    pairs, pose = np.array(problem.truth.pairs), np.array(problem.truth.pose)
    bound = noise_bound(RawInstance(source, target, pairs, pose, problem.scale_range))
    return Instance(
        problem.id, source, target, problem.model, problem.n_inliers, problem.scale_range, bound,
        seed=0,
    )  # fmt: skip


def judged(problem: Problem, answer: dict[str, Any]) -> dict[str, Any]:
    """Compare an answer with the best known pose and bound.

    The pose is improved by a local search first. The verdict is ``solved`` (its objective is within 1 %
    of the best known one), ``proven`` (the same, and certified by the bounds of the method), ``missed``
    (its objective is higher, or the pose is outside of the model), ``wrong`` (the method states a lower
    bound above the best known objective, or that a missed pose is optimal), or the status of a run
    without a pose.
    """
    record, status = read_record(problem.id), Status(answer["status"])
    row = {
        "problem": problem.id, "model": problem.model, "family": problem.family,
        "library_status": record.status(problem), "status": status.value, "objective": np.nan,
        "best_known": record.objective, "gap": np.nan, "time_s": answer.get("time_solve_s", np.nan),
        "note": answer.get("message", ""),
    }  # fmt: skip
    if answer.get("T_target_source") is None:
        return {**row, "verdict": status.value}
    try:
        pose = admissible(problem, answer["T_target_source"])
    except LibraryError as error:
        return {**row, "verdict": "missed", "note": str(error)}
    stated = dcreg.Problem(*problem.clouds, **problem.keywords())
    value = evaluate(problem, admissible(problem, polish(stated, pose)[0]))
    lower, is_right = answer.get("lower_bound"), value <= RIGHT_GAP * record.objective
    of_pose = answer.get("certificate_scope") in POSE_SCOPES
    row |= {"objective": value}
    if lower is not None and of_pose:
        row["gap"] = (value - max(lower, 0.0)) / value if value else 0.0
        tolerated = max(RIGHT_GAP * record.objective, lower + (answer.get("gap_tol") or 0.0))
        is_false = status is Status.OPTIMAL and value > tolerated * (1 + CROSSED)
        if lower > record.objective * (1 + CROSSED) or is_false:
            claim = "optimal" if is_false else f"lower bound {lower:.6g}"
            note = f"{claim}, but a pose with objective {record.objective:.6g} is known"
            return {**row, "verdict": "wrong", "note": note}
        if is_right and status is Status.OPTIMAL and row["gap"] <= DEFAULT_REL_GAP * (1 + CROSSED):
            return {**row, "verdict": "proven"}
    return {**row, "verdict": "solved" if is_right else "missed"}


def summary(name: str, table: pd.DataFrame, limit_s: float) -> str:
    """Return the table of a method as text: verdicts by status of the problems, and the profile."""
    verdicts = ["proven", "solved", "missed", "wrong"]
    others = sorted(set(table["verdict"]) - set(verdicts))
    counts = (
        pd.crosstab(table["library_status"], table["verdict"])
        .reindex(columns=[*verdicts, *others], fill_value=0)
        .assign(problems=lambda found: found.sum(axis=1))
    )
    right = table[table["verdict"].isin(("proven", "solved"))]
    gaps = table.groupby("library_status")["gap"].median()
    counts["median gap"] = gaps.map(lambda gap: "-" if np.isnan(gap) else f"{100 * gap:.2f} %")
    times = right.groupby("library_status")["time_s"].median().reindex(counts.index)
    counts["median time, s"] = times.map(lambda found: "-" if np.isnan(found) else f"{found:.3g}")
    counts = counts.rename_axis(index=None, columns="status")
    shares = ", ".join(
        # a method that stops at the limit ends a little after it
        f"{(right['time_s'] <= at * (LATE if at == limit_s else 1)).sum() / len(table):.0%} in {at:g} s"
        for at in PROFILE_S if at <= limit_s
    )  # fmt: skip
    date = time.strftime("%Y-%m-%d")
    return f"{name}, {limit_s:g} s per problem, {date}\n{counts.to_string()}\nsolved: {shares}"
