"""The estimated time of the planned runs that have not finished, from the times of those that have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines import registry
from dcreg.status import Status
from workflows.archives import archived
from workflows.compose import QUICK, ConfigError
from workflows.config import Experiment, Selection, load
from workflows.installed import runs_here
from workflows.journal import journalled
from workflows.stages.plan import Plan, PlannedRun, expand

Times = dict[tuple[str, str, str], list[float]]  # seconds by method, model and test


@dataclass(frozen=True)
class Outlook:
    """The planned runs of a method on one model, and the estimated seconds of the unfinished ones.

    A run is estimated by the median time of the method's finished runs on its test, including those of
    the quick part; a run that hit its time limit counts as the current limit. ``known``: every unfinished
    run has such an estimate. Runs without one count as the time limit.
    """

    method: str
    model: str
    tests: list[str]
    runs: int
    finished: int
    seconds: float
    known: bool


def outlook_of(plan: Plan, folder: Path) -> list[Outlook]:
    """Estimate the time of each method and model of a plan, given the finished runs in `folder`."""
    rows: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in plan.runs():
        rows.setdefault((run.method.name, run.chunk.model), []).append(run)
    kept = kept_runs(plan, folder)
    measured = measured_times(plan, folder, kept)
    outlook = []
    for (name, model), runs in rows.items():
        method = runs[0].method
        fingerprint = registry.fingerprint(method.baseline, options=method.options)
        is_here = runs_here(method)
        finished, seconds, known = 0, 0.0, True
        for run in runs:
            if kept.get(run.run_id, {}).get("fingerprint") == fingerprint:
                finished += 1
                continue
            if not is_here:  # ends at once as unavailable
                continue
            taken = measured.get((name, model, run.instance.test))
            known = known and taken is not None
            seconds += np.median(taken) if taken else plan.experiment.limits_of(method).time_s
        tests = list(dict.fromkeys(run.instance.test for run in runs))
        outlook.append(Outlook(name, model, tests, len(runs), finished, float(seconds), known))
    return outlook


def measured_times(plan: Plan, folder: Path, kept: dict[str, dict[str, Any]]) -> Times:
    """Return the measured seconds of a plan, and of the quick part where the plan has none."""
    measured = times_of(plan.runs(), kept, plan.experiment)
    for quick in _quick_part(plan):
        rows = kept_runs(quick, folder.with_name(quick.experiment.name))
        measured = {**times_of(quick.runs(), rows, plan.experiment), **measured}
    return measured


def kept_runs(plan: Plan, folder: Path) -> dict[str, dict[str, Any]]:
    """Return the finished runs of the plan's methods by run_id, if possible those of the present code."""
    kept: dict[str, dict[str, Any]] = {}
    for method in plan.methods:
        fingerprint = registry.fingerprint(method.baseline, options=method.options)
        finished = {**archived(method.name), **journalled(folder / "runs" / method.name)}
        for row in finished.values():
            if kept.get(row["run_id"], {}).get("fingerprint") != fingerprint:
                kept[row["run_id"]] = row
    return kept


def times_of(
    runs: Iterable[PlannedRun], kept: dict[str, dict[str, Any]], experiment: Experiment
) -> Times:
    """Return the seconds of finished runs per method, model and test under the limits of an experiment.

    A run that hit a limit of work counts as the time limit if the experiment has no such limit.
    """
    limits_of = {method.name: experiment.limits_of(method) for method in experiment.methods}
    times: Times = {}
    for run in runs:
        row, limits = kept.get(run.run_id, {}), limits_of.get(run.method.name)
        if limits is None or (time := row.get("time_solve_s")) is None:
            continue
        limited = {
            Status.NODE_LIMIT: limits.nodes is None,
            Status.ASSIGNMENT_LIMIT: limits.assignments is None,
        }
        if limited.get(row["status"], row["status"] == Status.TIME_LIMIT):
            time = limits.time_s
        key = run.method.name, run.chunk.model, run.instance.test
        times.setdefault(key, []).append(time)
    return times


def _quick_part(plan: Plan) -> Iterator[Plan]:
    """Yield the plan of the methods in the experiment's quick part, if it has one."""
    with suppress(ConfigError):
        quick = load(f"{plan.config}{QUICK}")
        known = {method.name for method in quick.methods}
        if shared := [method.name for method in plan.methods if method.name in known]:
            yield expand(quick, Selection(methods=shared))


def duration(seconds: float) -> str:
    """Format seconds with a unit that suits their size."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
