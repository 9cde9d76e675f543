"""The best pose that clearly differs from the answer, among the ends of the local searches."""

from __future__ import annotations

import math
from collections.abc import Iterable
from operator import itemgetter

import numpy as np

from dcreg.problem import (
    Moments,
    Problem,
    angle_between_deg,
    exact_objective,
    unit_length,
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
    source, target, k = problem.source, problem.target, problem.n_inliers
    radius, rounding = unit_length(source, target), exact_objective(source, target, k)
    if radius == 0.0:  # all points of each cloud coincide, and poses differ by rounding
        return None
    moments = Moments.of(source)
    minimum = DISTINCT * radius
    # a nearer one counts if it is as good: a repeated part, shifted by one period
    residual = math.sqrt(objective / k)
    nearer = min(minimum, max(_RESIDUALS * residual, _SHARE_OF_RADIUS * radius))
    others = [
        (value, moved, other)
        for other, value in ends
        if np.isfinite(value)
        and (moved := moments.displacement(other, T))
        > (nearer if value <= _EQUAL * objective + rounding else minimum)
    ]
    if not others:
        return None
    value, moved, other = min(others, key=itemgetter(0))
    ratio = (value + rounding) / (objective + rounding)
    return RunnerUp(other, ratio, angle_between_deg(other, T), moved)
