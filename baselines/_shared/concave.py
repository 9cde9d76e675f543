"""2D similarity registration as concave minimisation over matchings: shared by RPM-CAV and RPM-PA.

For a fixed matching P of k pairs the best pose has a closed form, and what is left depends on P through
seven sums over its pairs, the statistics ``u = (sum |x|^2, sum x, sum y, sum x.y, sum x^y)``, and one
more linear term ``L = sum |y|^2``:

    E(P) = min over theta of E(P, theta) = L(P) + f(u(P)).

``E(P, theta)`` is affine in (u, L) for every theta, so f is a minimum of affine functions: concave,
over any set of admissible poses. With ``V = sum |x|^2 - |sum x|^2 / k``, r the length of
``(sum x.y, sum x^y)`` after centring, and the scale s kept in [low, high],

    f(u) = -|sum y|^2 / k + min over s of (V s^2 - 2 s r),

finite for every u, also for those that no matching attains (there V may be negative). A linear
function of (u, L) is least over all matchings at a k-cardinality assignment, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from baselines._shared.kernels.statistics import N_STATISTICS, concave, least_linear, statistics
from baselines.contract import Instance
from dcreg.local import fit_pose, polish
from dcreg.local.assignment import pairs_of
from dcreg.problem import Frame, Problem
from dcreg.search import Budget
from dcreg.spaces import Similarity2D

SCOPE = "similarity pose"
_FLAT = 1e-8  # relative extent below which all matchings agree in a statistic


class OutOfTimeError(Exception):
    """The time limit came before the search had its first region; the incumbent stands."""


class History:
    """Rows of a bound history, in squared units of the input: one whenever a bound moved, and the last.

    Parameters
    ----------
    budget : Budget
        Its clock counts.
    area : float
        Squared units of the input in one squared unit of the search.
    """

    def __init__(self, budget: Budget, area: float) -> None:
        self.budget, self.area = budget, area
        self.rows: list[dict[str, Any]] = []

    def add(self, lower: float, upper: float, n_nodes: int, n_assignments: int, last: bool) -> None:
        """The state of the search; kept when a bound moved, and always the last one."""
        bounds = {"lower_bound": lower * self.area, "upper_bound": upper * self.area}
        if self.rows and not last and bounds.items() <= self.rows[-1].items():
            return
        self.rows.append(
            {
                "stage": "search",
                "time_s": self.budget.elapsed(),
                "n_nodes": n_nodes,
                "n_assignments": n_assignments,
                **bounds,
            }
        )


class Clouds(NamedTuple):
    """A normalised problem as the kernels take it."""

    source: np.ndarray  # (n, 2)
    target: np.ndarray  # (m, 2)
    k: int
    low: float  # admissible scale
    high: float


@dataclass
class Incumbent:
    """The best matching's pose so far, in normalised coordinates, and the work spent."""

    source: np.ndarray
    target: np.ndarray
    k: int
    scale_range: tuple[float, float]
    pose: np.ndarray
    value: float
    n_assignments: int

    def beaten_by(self, value: float) -> bool:
        """Whether a matching of this value is better by more than rounding."""
        return value < self.value - 1e-9 * abs(self.value)

    def offer(self, col_of: np.ndarray) -> bool:
        """Descend from a matching that is better than the incumbent; True: it became the incumbent."""
        pairs = pairs_of(col_of)
        pose = fit_pose(self.source[pairs[:, 0]], self.target[pairs[:, 1]], self.scale_range)
        pose, value, _, spent = polish(self.source, self.target, pose, self.k, self.scale_range)
        self.n_assignments += spent
        if value >= self.value:
            return False
        self.pose, self.value = pose, value
        return True


@dataclass
class Reduced:
    """An instance as concave minimisation, in the library's normalised coordinates."""

    frame: Frame
    clouds: Clouds
    incumbent: Incumbent

    @classmethod
    def of(cls, instance: Instance, budget: Budget) -> Reduced:
        """The first incumbent comes from the descents that start the library's own search, so that
        every branch and bound starts alike."""
        problem = Problem(
            instance.source, instance.target, instance.n_inliers, "similarity2d",
            instance.scale_range,
        )  # fmt: skip
        frame = Frame.of(problem)
        source, target = frame.source(problem.source), frame.target(problem.target)
        k, scale_range = problem.n_inliers, problem.scale_range
        space = Similarity2D(source, target, k, scale_range)
        theta, value, spent = space.start(budget)
        start = Incumbent(source, target, k, scale_range, space.pose(theta), value, spent)
        return cls(frame, Clouds(source, target, k, *scale_range), start)

    @property
    def area(self) -> float:
        """Squared target units per squared normalised unit."""
        return self.frame.area

    def pose(self) -> np.ndarray:
        """The incumbent in the coordinates of the instance."""
        return self.frame.pose(self.incumbent.pose)


@dataclass
class Coordinates:
    """Affine coordinates z of the statistics that matchings can reach: ``u = origin + axes z``.

    Statistics on which all matchings agree (say the sum of x when every source point is matched),
    also combinations of them, are left out, exactly the flat directions of the convex hull.

    Attributes
    ----------
    lower, upper : (r,) arrays
        Range of z over all matchings.
    """

    origin: np.ndarray
    axes: np.ndarray
    inverse: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def dim(self) -> int:
        return self.axes.shape[1]


class Support:
    """Oracle of extreme points: matchings that minimise linear functions of (u, L).

    A matching better than the incumbent is offered to it. Points are ``u(P)``, or ``(u, L)(P)``.
    """

    def __init__(
        self,
        clouds: Clouds,
        incumbent: Incumbent,
        budget: Budget,
        with_fixed: bool = False,
    ) -> None:
        self.clouds, self.incumbent, self.with_fixed = clouds, incumbent, with_fixed
        self.budget = budget
        self.n_assignments = 0
        self.points: list[np.ndarray] = []

    @property
    def dim(self) -> int:
        return N_STATISTICS + self.with_fixed

    def least(self, direction: np.ndarray) -> np.ndarray:
        """The point with the least ``direction . point``."""
        if self.budget.is_over:
            raise OutOfTimeError
        fixed_weight = float(direction[-1]) if self.with_fixed else 0.0
        weights = np.ascontiguousarray(direction[:N_STATISTICS])
        _, col_of = least_linear(self.clouds, weights, fixed_weight)
        self.n_assignments += 1
        u, fixed = statistics(self.clouds, col_of)
        if self.incumbent.beaten_by(fixed + concave(self.clouds, u)):
            self.incumbent.offer(col_of)
        point = np.append(u, fixed) if self.with_fixed else u
        self.points.append(point)
        return point

    def coordinates(self) -> Coordinates:
        """Coordinates of the affine hull of all points, each scaled to the range [0, 1]."""
        identity = np.eye(self.dim)
        low = np.array([self.least(axis) @ axis for axis in identity])
        high = np.array([self.least(-axis) @ axis for axis in identity])
        typical = np.maximum(np.abs(low), np.abs(high)).max()
        scale = np.where(high - low > _FLAT * typical, high - low, 0.0)
        moving = np.flatnonzero(scale)
        basis = self._hull_directions(moving, scale[moving])
        axes = np.zeros((self.dim, basis.shape[1]))
        axes[moving] = scale[moving, None] * basis
        origin = self.points[0].copy()
        inverse = np.zeros(axes.T.shape)
        inverse[:, moving] = basis.T / scale[moving]
        if basis.shape[1] == len(moving):  # nothing but coordinates: their ranges are known
            lower = (low[moving] - origin[moving]) / scale[moving]
            upper = (high[moving] - origin[moving]) / scale[moving]
        else:
            lower = np.array([row @ (self.least(row) - origin) for row in inverse])
            upper = np.array([row @ (self.least(-row) - origin) for row in inverse])
        width = upper - lower
        origin = origin + axes @ lower
        return Coordinates(
            origin,
            axes * width,
            inverse / width[:, None],
            np.zeros(len(width)),
            np.ones(len(width)),
        )

    def _hull_directions(self, moving: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Orthonormal columns that span all differences of points (in scaled coordinates)."""
        full = np.eye(len(moving))
        while len(moving):
            spread = (np.array(self.points)[:, moving] - self.points[0][moving]) / scale
            _, singular, vt = np.linalg.svd(spread)
            rank = int((singular > _FLAT).sum())
            if rank == len(moving):
                return full
            for row in vt[rank:]:  # flat as far as we know: ask for the extremes
                direction = np.zeros(self.dim)
                direction[moving] = row / scale
                if (self.least(-direction) - self.least(direction)) @ direction > _FLAT:
                    break  # not flat: the new points enter the next round
            else:
                return vt[:rank].T
        return full
