"""The objective at a pose, against other poses and against certified bounds."""

from __future__ import annotations

import numpy as np

from dcreg.names import NORM_SCOPES, POSE_SCOPES
from workflows.metrics.case import Case, metric


@metric("target unit²", "lower", np.inf, recorded=True)
def objective(case: Case) -> float:
    """Minimum sum of squared residuals of n_inliers one-to-one pairs at the pose; empty for large
    clouds, and for methods that received fewer points."""
    return case.objective


@metric("target unit²", "none", recorded=True)
def objective_true(case: Case) -> float:
    """The objective at the reference pose."""
    return case.objective_true


@metric("target unit²", "none", relative=True)
def objective_best(case: Case) -> float:
    """Minimum objective of all admissible poses known for the instance and n_inliers: those of all
    methods, and the reference."""
    raise NotImplementedError


@metric("target unit²", "lower", np.inf, relative=True)
def objective_regret(case: Case) -> float:
    """Objective - objective_best; empty if the pose is not admissible."""
    raise NotImplementedError


@metric("target unit²", "lower", recorded=True)
def bound_violation(case: Case) -> float:
    """Amount by which lower_bound exceeds objective_true: if above 0, the certificate is wrong; empty
    if the bound refers to another objective."""
    is_comparable = case.scope in (*POSE_SCOPES, *NORM_SCOPES)
    if not is_comparable or np.isnan(case.lower_bound + case.objective_true):
        return float("nan")
    excess = case.lower_bound - case.objective_true
    rounding = 1e-9 * max(1.0, abs(case.objective_true))
    return float(excess) if excess > rounding else 0.0
