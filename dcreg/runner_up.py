"""The best pose that clearly differs from the answer, among the ends of the local searches."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from dcreg.problem import (
    Problem,
    exact_objective,
    nearest_rotation,
    rms_radius,
    rotation_angle_deg,
)
from dcreg.result import RunnerUp

# Poses differ if they displace the source by more than this fraction of the target's RMS radius.
DISTINCT = 0.2
# Poses whose objectives differ by less than this factor differ already if they displace the source by
# more than three RMS residuals, at least 1 % of that radius.
_EQUAL, _RESIDUALS, _SHARE_OF_RADIUS = 1.02, 3.0, 0.01


def find_runner_up(
    problem: Problem, T: np.ndarray, objective: float, ends: Iterable[tuple[np.ndarray, float]]
) -> RunnerUp | None:
    """Return the cheapest of the `ends` that differs from the pose `T`, or None.

    Parameters
    ----------
    problem : Problem
    T : (d+1, d+1) array
    objective : float
        The objective at `T`.
    ends : iterable of (pose, objective)
        Final poses of local searches, in the coordinates of the clouds.
    """
    source, target, d = problem.source, problem.target, problem.dim
    minimum = DISTINCT * rms_radius(target)
    centre = source.mean(axis=0)
    covariance = np.cov(source, rowvar=False, bias=True).reshape(d, d)

    def displacement(other: np.ndarray) -> float:
        linear, shift = other[:d, :d] - T[:d, :d], other[:d, d] - T[:d, d]
        squared = ((linear @ centre + shift) ** 2).sum() + np.trace(linear @ covariance @ linear.T)
        return float(np.sqrt(max(squared, 0.0)))  # rounding can make it negative

    # a nearer one counts if it is as good: a repeated part, shifted by one period
    residual = math.sqrt(objective / problem.n_inliers)
    nearer = min(minimum, max(_RESIDUALS * residual, _SHARE_OF_RADIUS * rms_radius(target)))
    others = [
        (T_other, value)
        for T_other, value in ends
        if np.isfinite(value)
        and displacement(T_other) > (nearer if value <= _EQUAL * objective else minimum)
    ]
    if not others:
        return None
    other, value = min(others, key=lambda end: end[1])
    rounding = exact_objective(source, target, problem.n_inliers)
    angle = rotation_angle_deg(nearest_rotation(other[:d, :d] @ T[:d, :d].T))
    ratio = (value + rounding) / (objective + rounding)
    return RunnerUp(other, ratio, abs(angle), displacement(other))
