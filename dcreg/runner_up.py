"""The runner-up pose: the best pose found that clearly differs from the result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dcreg.files import plain
from dcreg.problem import (
    EXACT,
    Problem,
    nearest_rotation,
    rms_radius,
    rotation_angle_deg,
    unit_length,
)

# Poses differ if they displace the source by more than this fraction of the target's RMS radius.
DISTINCT = 0.2


@dataclass(frozen=True)
class RunnerUp:
    """The best distinct pose at which a local descent of the search ended; a better one may exist.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
    objective_ratio : float
        Objective of this pose divided by the objective of the result. Near 1 the data hardly
        distinguish the two poses.
    rotation_difference_deg : float
        Angle between the two rotations.
    rms_displacement : float
        RMS distance between the two images of the source, in units of the target.
    """

    T_target_source: np.ndarray
    objective_ratio: float
    rotation_difference_deg: float
    rms_displacement: float

    def __str__(self) -> str:
        ratio = f"{self.objective_ratio:.3g}" if self.objective_ratio < 1000 else "over 1000"
        return f"{ratio} times the objective, {self.difference} (best one found, not proven)"

    @property
    def difference(self) -> str:
        """Its difference from the pose of the result, in words."""
        return (
            f"displaced by {self.rms_displacement:.3g} (RMS), "
            f"rotated by {self.rotation_difference_deg:.0f} deg"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return plain(self)


def find_runner_up(
    problem: Problem, T: np.ndarray, objective: float, ends: Iterable[tuple[np.ndarray, float]]
) -> RunnerUp | None:
    """Return the cheapest of the `ends` that differs from the pose `T`, or None.

    Parameters
    ----------
    problem : Problem
    T : (d+1, d+1) array
    objective : float
        At `T`.
    ends : iterable of (pose, objective)
        Final poses of local descents, in the coordinates of the clouds.
    """
    source, target, d = problem.source, problem.target, problem.dim
    minimum = DISTINCT * rms_radius(target)
    centre = source.mean(axis=0)
    covariance = np.cov(source, rowvar=False, bias=True).reshape(d, d)

    def displacement(other: np.ndarray) -> float:
        linear, shift = other[:d, :d] - T[:d, :d], other[:d, d] - T[:d, d]
        squared = ((linear @ centre + shift) ** 2).sum() + np.trace(linear @ covariance @ linear.T)
        return float(np.sqrt(squared))

    others = [end for end in ends if np.isfinite(end[1]) and displacement(end[0]) > minimum]
    if not others:
        return None
    other, value = min(others, key=lambda end: end[1])
    rounding = EXACT * problem.n_inliers * (unit_length(source, target) or 1.0) ** 2
    angle = rotation_angle_deg(nearest_rotation(other[:d, :d] @ T[:d, :d].T))
    ratio = (value + rounding) / (objective + rounding)
    return RunnerUp(other, ratio, abs(angle), displacement(other))
