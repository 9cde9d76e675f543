"""Repeat one run in this process and compare it with the stored one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from baselines import registry
from baselines.contract import Baseline, Instance, Solution
from dcreg.status import Status
from workflows import CHECKOUT, UserError, archives, provenance, records
from workflows.config import Experiment, load, origin, search_next_to
from workflows.instances import content_digest
from workflows.integrity import readable, refuse_damaged
from workflows.outcomes import ENDED, STARTED, stated
from workflows.stages.generate import instance_of
from workflows.stages.plan import Plan, PlannedRun, expand
from workflows.stages.solve import bound_ratio, exact_fit
from workflows.stages.worker import COUNTERS
from workflows.versions import are_equal, comparable

if TYPE_CHECKING:
    import pandas as pd

SAME, DIFFERENT = "same", "different"
ROUNDING = "the stored run is from another machine, whose rounding can change its counters"


class Stored(NamedTuple):
    """A stored run, and the provenance of its table."""

    row: dict[str, Any]
    provenance: dict[str, Any]


def replay(run_id: str, experiment: str = "", results: Path = Path("results")) -> dict[str, Any]:
    """Make the instance again, solve it, and compare the result with the stored one.

    Parameters
    ----------
    run_id : str
    experiment : str
        Config of the run; if empty, that of the stored run.
    results : Path
        Folder of results that is searched for the stored run before the archives.

    Returns
    -------
    dict
        The result. The entry ``stored`` says whether the stored result is the same, or why the two are
        not compared.

    Raises
    ------
    UserError
        There is no such run, it was only planned, or the method is not available.
    """
    repetition = Repetition.of(run_id, experiment, results)
    repetition.method.warm_up(repetition.instance)
    return repetition.result()


@dataclass(frozen=True)
class Repetition:
    """A run to repeat: its plan, its instance, its method, and the stored run if there is one."""

    plan: Plan
    run: PlannedRun
    instance: Instance
    method: Baseline
    stored: Stored | None

    @classmethod
    def of(cls, run_id: str, experiment: str = "", results: Path = Path("results")) -> Repetition:
        """Find a run and make its instance again; see `replay`."""
        stored = _stored(run_id, results)
        if stored is None and not experiment:
            raise UserError(
                f"no run {run_id!r} in the archives or in {results}; take one from column run_id of "
                "tables/runs.csv, or give its results (--results; make: RESULTS=…) or its experiment "
                "(--experiment)"
            )
        if stored and stored.row["outcome"] not in STARTED:
            raise UserError(
                f"run {run_id} was not started (outcome: {stored.row['outcome']}); choose one whose "
                "column outcome in tables/runs.csv is finished or limited"
            )
        plan = _plan(experiment, stored)
        run = next((run for run in plan.runs() if run.run_id == run_id), None)
        if run is None:
            raise UserError(
                f"experiment {plan.experiment.name}: no run {run_id!r}; take one from column run_id of "
                "its tables/runs.csv"
            )
        instance = instance_of(
            run.instance,
            run.method.n_inliers_ratio,
            plan.experiment.seed,
            registry.oracle_outliers(run.method.baseline, run.method.options),
            run.method.n_points,
        )
        method = registry.load(run.method.baseline, **run.method.options)
        if reason := method.available() or method.supports(instance):
            raise UserError(f"{run.method.name}: {reason}")
        return cls(plan, run, instance, method, stored)

    def result(self) -> dict[str, Any]:
        """Solve the instance again and compare the result; see `replay`."""
        limits = self.plan.experiment.limits_of(self.run.method).of_run()
        return _compared(self, self.method.solve(self.instance, limits))


def _plan(experiment: str, stored: Stored | None) -> Plan:
    """Return the plan that contains a run: of the given config, or of the one stored with the run."""
    if experiment or stored is None:
        return expand(load(experiment), None, origin(experiment), None)
    try:
        settings = Experiment.model_validate(stored.provenance["config"])
    except (KeyError, ValidationError):  # stored by another version
        return _plan(stored.row["experiment"], None)
    if config := stored.provenance.get("config_file"):
        search_next_to(CHECKOUT / config)
    return expand(settings, None, settings.name, None)


def _compared(repetition: Repetition, solution: Solution) -> dict[str, Any]:
    run, instance, stored = repetition.run, repetition.instance, repetition.stored
    pose, exact = solution.T_target_source, exact_fit(instance)
    ratio = bound_ratio(solution.lower_bound, solution.upper_bound, exact)
    answer = {
        "status": stated(Status(solution.status).value, ratio),
        "T_target_source": None if pose is None else np.asarray(pose).tolist(),
        "lower_bound": solution.lower_bound,
        "upper_bound": solution.upper_bound,
        **{name: solution.counters.get(name) for name in COUNTERS},
    }
    identity = {
        "instance_digest": content_digest(instance),
        "fingerprint": registry.fingerprint(run.method.baseline, options=run.method.options),
    }
    return {
        "method": run.method.name,
        "test": f"{run.instance.shape} {run.instance.test} {run.instance.level:g}",
        "trial": run.instance.trial,
        "message": solution.message,
        "certificate_scope": solution.certificate_scope,
        **answer,
        "stored": _comparison({**answer, **identity}, stored.row if stored else None, run),
    }


def _comparison(found: dict[str, Any], stored: dict[str, Any] | None, run: PlannedRun) -> str:
    """Return whether a result equals the stored one, or why they are not compared."""
    if stored is None:
        return "not compared: no stored run"
    for name, what in (("instance_digest", "instance"), ("fingerprint", "version of the method")):
        if found[name] != stored[name]:
            return f"not compared: another {what} ({stored[name]} stored, {found[name]} here)"
    if not registry.read_card(run.method.baseline).deterministic:
        return "not compared: the method is not deterministic"
    if stored["outcome"] not in ENDED:
        return f"not compared: the stored run has the status {stored['status']}"
    one, other = comparable(found), comparable(stored)
    if one == other:
        return SAME
    if are_equal(one, other):
        return "not compared: one of the runs hit the time or memory limit"
    names = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    here = provenance.machine_card()["machine_id"]
    reason = "" if stored.get("machine_id", here) == here else f"; {ROUNDING}"
    return f"{DIFFERENT}: {', '.join(names)}{reason}"


def _stored(run_id: str, results: Path) -> Stored | None:
    """Return the run of `results`, else of the latest archive that has it, without missing numbers.

    A run that was only planned is returned if none was started.
    """
    planned = None
    for found in chain(_in_results(run_id, results), _in_archives(run_id)):
        if found.row["outcome"] in STARTED:
            return found
        planned = planned or found
    return planned


def _in_results(run_id: str, results: Path) -> Iterator[Stored]:
    for path in sorted(results.glob("**/tables/runs.parquet")):
        refuse_damaged(path.parent)
        with readable(path):
            row = _row(path, run_id)
        if row:
            yield Stored(row, _json(path.parent))


def _in_archives(run_id: str) -> Iterator[Stored]:
    for folder in reversed(archives.folders()):
        archives.check(folder)
        if row := _row(folder / archives.RUNS, run_id):
            yield Stored(row, _json(folder / "experiments" / row["experiment"]))


def _json(folder: Path) -> dict[str, Any]:
    path = folder / "provenance.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _row(path: Path, run_id: str) -> dict[str, Any] | None:
    import pandas as pd

    runs: pd.DataFrame = pd.read_parquet(path, filters=[("run_id", "==", run_id)])
    if runs.empty:
        return None
    where = str(path)
    records.check_version(runs["schema_version"].iloc[0], where, records.RUN_AGAIN)
    row = {str(name): value for name, value in runs.iloc[0].items() if value == value}
    pose = row["T_target_source"]
    return {**row, "T_target_source": json.loads(pose) if pose else None}
