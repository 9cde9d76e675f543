"""Repeat one run in this process, for debugging."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines import registry
from workflows.config import ConfigError
from workflows.stages.generate import instance_of
from workflows.stages.plan import Plan
from workflows.stages.worker import COUNTERS


def replay(plan: Plan, run_id: str) -> dict[str, Any]:
    """Make the instance again, solve it, and return the result with pose and bounds."""
    run = next((run for run in plan.runs() if run.run_id == run_id), None)
    if run is None:
        raise ConfigError(
            f"experiment {plan.experiment.name}: no run {run_id!r}; "
            "take one from column run_id of its tables/runs.csv"
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
        raise ConfigError(f"{run.method.name}: {reason}")
    method.warm_up(instance)
    solution = method.solve(instance, plan.experiment.limits_of(run.method).of_run())
    pose = solution.T_target_source
    return {
        "method": run.method.name,
        "test": f"{run.instance.shape} {run.instance.test} {run.instance.level:g}",
        "trial": run.instance.trial,
        "status": solution.status,
        "message": solution.message,
        "T_target_source": None if pose is None else np.asarray(pose).tolist(),
        "lower_bound": solution.lower_bound,
        "upper_bound": solution.upper_bound,
        "certificate_scope": solution.certificate_scope,
        **{name: solution.counters.get(name) for name in COUNTERS},
    }
