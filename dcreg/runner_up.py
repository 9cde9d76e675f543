"""The best pose that differs from the one found: how far the data tell them apart."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dcreg.problem import (
    EXACT,
    Problem,
    nearest_rotation,
    rms_radius,
    rotation_angle_deg,
    unit_length,
)

# Poses differ whose images of the source lie farther apart than this share of the target's RMS radius.
APART = 0.2


@dataclass(frozen=True)
class Rival:
    """The best other place where a descent of the search ended; a better one may exist.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
        Its pose, where the descent left it.
    objective_ratio : float
        Its objective in units of that of the pose found: near 1 the two can hardly be told apart.
    turned_deg : float
        Angle between the two rotations.
    apart : float
        RMS distance between the two images of the source, in units of the target.
    """

    T_target_source: np.ndarray
    objective_ratio: float
    turned_deg: float
    apart: float

    def __str__(self) -> str:
        ratio = f"{self.objective_ratio:.3g}" if self.objective_ratio < 1000 else "over 1000"
        return f"{ratio} times the objective, {self.way} (the best that was met, not proven)"

    @property
    def way(self) -> str:
        """Where it lies, in words."""
        return f"{self.apart:.3g} away (RMS), turned by {self.turned_deg:.0f} deg"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "T_target_source": self.T_target_source.tolist(),
            "objective_ratio": self.objective_ratio,
            "turned_deg": self.turned_deg,
            "apart": self.apart,
        }


def find_rival(
    problem: Problem, T: np.ndarray, objective: float, ends: Iterable[tuple[np.ndarray, float]]
) -> Rival | None:
    """The cheapest of the `ends` that differs from the pose `T`, if any does.

    Parameters
    ----------
    problem : Problem
    T : (d+1, d+1) array
    objective : float
        At `T`.
    ends : iterable of (pose, objective)
        In units of the clouds.
    """
    source, target, d = problem.source, problem.target, problem.dim
    least = APART * rms_radius(target)
    centre = source.mean(axis=0)
    spread = np.cov(source, rowvar=False, bias=True).reshape(d, d)

    def distance(other: np.ndarray) -> float:
        linear, shift = other[:d, :d] - T[:d, :d], other[:d, d] - T[:d, d]
        squared = ((linear @ centre + shift) ** 2).sum() + np.trace(linear @ spread @ linear.T)
        return float(np.sqrt(squared))

    others = [end for end in ends if np.isfinite(end[1]) and distance(end[0]) > least]
    if not others:
        return None
    other, value = min(others, key=lambda end: end[1])
    rounding = EXACT * problem.n_inliers * (unit_length(source, target) or 1.0) ** 2
    angle = rotation_angle_deg(nearest_rotation(other[:d, :d] @ T[:d, :d].T))
    ratio = (value + rounding) / (objective + rounding)
    return Rival(other, ratio, abs(angle), distance(other))
