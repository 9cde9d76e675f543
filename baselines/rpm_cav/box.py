"""The bound of RPM-CAV with poses restricted to a box, for comparisons with bounds over boxes.

RPM-CAV divides statistics of the matching, not poses. Its bound over a box of poses is the bound of
its root simplex with f minimised over the poses of that box only; f is still concave.
"""

from __future__ import annotations

import numpy as np

from baselines._shared.concave import Clouds, Incumbent, Support
from baselines._shared.kernels.statistics import N_STATISTICS, minimum_linear
from baselines.contract import Instance
from baselines.rpm_cav.kernels import bound_simplex
from baselines.rpm_cav.search import root_simplex
from dcreg.assignment.objective import objective
from dcreg.search import Budget

_ASCENTS = 30  # of the Lagrangian: a single simplex serves the whole box


class BoxBound:
    """Bounds over boxes of ``theta = (s cos a, s sin a, tx, ty)`` in the units of an instance."""

    def __init__(self, instance: Instance) -> None:
        self.instance = instance
        source, target = (
            np.array(points, dtype=float, order="C")
            for points in (instance.source, instance.target)
        )
        self.clouds = Clouds(source, target, instance.n_inliers, *instance.scale_range)
        # with a value of minus infinity no matching is kept
        support = Support(Incumbent(self.clouds, Budget(), -np.inf))
        self.z = support.coordinates()
        self.root = root_simplex(support, self.z) if self.z.dim else np.empty((1, 0))

    def __call__(self, lower: np.ndarray, upper: np.ndarray) -> float:
        """Return a lower bound of the objective over the box, including inadmissible scales."""
        clouds, z = self.clouds, self.z
        points = z.origin + self.root @ z.axes.T
        values = np.array([least_over_box(clouds.k, u, lower, upper) for u in points])
        if z.dim == 0:
            return float(minimum_linear(clouds, np.zeros(N_STATISTICS), 1.0)[0] + values[0])
        a, b, tx, ty = 0.5 * (lower + upper)
        centre = np.array([[a, -b, tx], [b, a, ty], [0.0, 0.0, 1.0]])
        target, _ = objective(clouds.source, clouds.target, centre, clouds.k)
        col_of = np.empty(len(clouds.source), np.int64)
        bound, _, _ = bound_simplex(
            clouds, z.origin, z.inverse, self.root, values, target, _ASCENTS, col_of
        )
        return float(bound)


def least_over_box(k: int, u: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """Return a lower bound of ``E(P, theta) - L(P)`` over the box at statistics u, exact for a point.

    For fixed (t1, t2) the minimum over each translation has a closed form, concave in the coordinate of
    the moved mean. Its secant over the box leaves a separable quadratic in (t1, t2).
    """
    square, x1, x2, y1, y2, dot, cross = u
    linear = np.array([-2.0 * dot, -2.0 * cross])
    constant = 0.0
    for axis, (row, offset) in enumerate(
        [(np.array([x1, -x2]), -y1), (np.array([x2, x1]), -y2)], start=2
    ):
        ends = np.array([row * lower[:2], row * upper[:2]])
        least = ends.min(axis=0).sum() + offset
        most = ends.max(axis=0).sum() + offset
        at_least, at_most = (
            _least_translation(k, moment, lower[axis], upper[axis]) for moment in (least, most)
        )
        slope = (at_most - at_least) / (most - least) if most > least else 0.0
        linear += slope * row
        constant += at_least + slope * (offset - least)
    return constant + sum(
        _least_quadratic(square, linear[axis], lower[axis], upper[axis]) for axis in (0, 1)
    )


def _least_translation(k: int, moment: float, low: float, high: float) -> float:
    t = min(max(-moment / k, low), high)
    return float(k * t * t + 2.0 * t * moment)


def _least_quadratic(square: float, linear: float, low: float, high: float) -> float:
    ends = min((square * t + linear) * t for t in (low, high))
    inner = -0.5 * linear / square if square > 0.0 else low
    return float(min(ends, (square * inner + linear) * inner) if low < inner < high else ends)
