"""2D similarity registration as concave minimisation over matchings, for RPM-CAV and RPM-PA.

For a fixed matching P of k pairs the best pose has a closed form. The minimum then depends on P only
through seven sums over its pairs, the statistics ``u = (sum |x|^2, sum x, sum y, sum x.y, sum x^y)``,
and a linear term ``L = sum |y|^2``:

    E(P) = min over theta of E(P, theta) = L(P) + f(u(P)).

``E(P, theta)`` is affine in (u, L) for every theta, so f is a minimum of affine functions and concave
over any set of admissible poses. With ``V = sum |x|^2 - |sum x|^2 / k``, r the length of ``(sum x.y,
sum x^y)`` after centring, and the scale s in [low, high],

    f(u) = -|sum y|^2 / k + min over s of (V s^2 - 2 s r),

which is finite for every u, even if no matching attains u (V may then be negative). A k-cardinality
assignment minimises a linear function of (u, L) over all matchings exactly.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from baselines._shared.cubes import OutOfTimeError
from baselines._shared.kernels.statistics import N_STATISTICS, concave, minimum_linear, statistics
from baselines._shared.tolerance import absolute_tolerance
from baselines.contract import Instance, Solution
from dcreg.assignment.objective import objective, pairs_of
from dcreg.problem import Frame, Problem, apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.result import Trace
from dcreg.search import Budget, Event
from dcreg.status import Status

SCOPE = "similarity pose"
_FLAT = 1e-8  # relative extent below which a statistic counts as constant over all matchings


class Clouds(NamedTuple):
    """A normalised problem in the form of the kernels."""

    source: np.ndarray  # (n, 2)
    target: np.ndarray  # (m, 2)
    k: int
    low: float  # admissible scale
    high: float

    @property
    def scale_range(self) -> tuple[float, float]:
        return self.low, self.high


@dataclass
class Incumbent:
    """The best matching among those that the search assigned: E(P) and the pose that attains it.

    With `alternates`, a local search starts from each better matching. It alternates the best pose for a
    matching and the best matching for a pose; the latter minimises a linear function above the concave
    one.
    """

    clouds: Clouds
    budget: Budget
    value: float = np.inf
    pose: np.ndarray = field(default_factory=lambda: np.eye(3))
    alternates: bool = False
    n_assignments: int = 0

    def beaten_by(self, value: float) -> bool:
        """Return whether a matching of this value is better by more than rounding."""
        return value < self.value * (1.0 - 1e-9)

    def offer(self, col_of: np.ndarray) -> bool:
        """Fit the pose to a matching; return whether it replaced the incumbent."""
        source, target, k, *_ = self.clouds
        is_better = self._take(pairs_of(col_of))
        improves = is_better and self.alternates
        while improves and not self.budget.is_over:
            self.n_assignments += 1
            improves = self._take(objective(source, target, self.pose, k)[1])
        return is_better

    def _take(self, pairs: np.ndarray) -> bool:
        x, y = self.clouds.source[pairs[:, 0]], self.clouds.target[pairs[:, 1]]
        pose = fit_pose(x, y, self.clouds.scale_range)
        value = float(((apply_pose(pose, x) - y) ** 2).sum())
        if not self.beaten_by(value):
            return False
        self.pose, self.value = pose, value
        return True


@dataclass
class Reduced:
    """An instance as concave minimisation, in the normalised coordinates of the library.

    `gap_tol` is the absolute tolerance for a factor of the RMS radius of the target.
    """

    frame: Frame
    incumbent: Incumbent
    gap_tol: float

    @classmethod
    def of(
        cls, instance: Instance, budget: Budget, factor: float, alternates: bool = False
    ) -> Reduced:
        """Normalise; there is no incumbent before the first assignment of the search."""
        problem = Problem(
            instance.source, instance.target, instance.n_inliers, "similarity2d",
            instance.scale_range,
        )  # fmt: skip
        frame = Frame.of(problem)
        source, target = frame.source(problem.source), frame.target(problem.target)
        clouds = Clouds(source, target, problem.n_inliers, *problem.scale_range)
        gap_tol = absolute_tolerance(target, clouds.k, factor)
        return cls(frame, Incumbent(clouds, budget, alternates=alternates), gap_tol)

    @property
    def clouds(self) -> Clouds:
        return self.incumbent.clouds

    @property
    def area(self) -> float:
        """Return the squared target units per squared normalised unit."""
        return self.frame.area

    def pose(self) -> np.ndarray:
        """Return the incumbent in the coordinates of the instance."""
        return self.frame.pose(self.incumbent.pose)


@dataclass
class ConcaveSearch(abc.ABC):
    """A running search; bounds are in normalised units, the incumbent is kept in `reduced`.

    Attributes
    ----------
    reduced : Reduced
    gap_tol : float
        In normalised units.
    status : Status or None
        None during the search.
    n_nodes, n_assignments, dim : int
        Regions bounded, their assignments, and dimensions of the statistics.
    history : Trace
        An event for every changed bound and for the end, in squared units of the input.
    """

    reduced: Reduced
    gap_tol: float
    status: Status | None = field(default=None, init=False)
    lower_bound: float = field(default=0.0, init=False)  # a sum of squares
    n_nodes: int = field(default=0, init=False)
    n_assignments: int = field(default=0, init=False)
    dim: int = field(default=0, init=False)
    history: Trace = field(default_factory=Trace, init=False)

    @property
    def budget(self) -> Budget:
        return self.reduced.incumbent.budget

    @property
    def upper_bound(self) -> float:
        return self.reduced.incumbent.value

    @property
    def n_spent(self) -> int:
        """Return the assignments solved, including those of local searches."""
        return self.n_assignments + self.reduced.incumbent.n_assignments

    @property
    def cutoff(self) -> float:
        """Return the bound from which on a region contains no matching better by the tolerance."""
        return self.upper_bound - self.gap_tol

    @abc.abstractmethod
    def run(self) -> None:
        """Search until a bound or a limit stops it; `status` says which."""

    def ended(self, nbytes: int, share: float) -> Status | None:
        """Return why the search stops, or None.

        Parameters
        ----------
        nbytes : int
            Memory of its regions.
        share : float
            Share of the memory limit for the regions.
        """
        budget = self.budget
        if self.lower_bound >= self.cutoff:
            return Status.OPTIMAL
        if budget.is_over:
            return Status.TIME_LIMIT
        return budget.spent(self.n_nodes, self.n_spent, nbytes / share)

    def record(self, n_open: int = 0) -> None:
        """Record the state of the search when a bound changed, and at the end."""
        kind = "bound" if self.status is None else "end"
        event = Event(
            kind, "search", self.budget.elapsed(), self.n_nodes, self.n_spent, n_open,
            self.lower_bound, self.upper_bound, "" if self.status is None else self.status.value,
        ).scaled(self.reduced.area)  # fmt: skip
        last = self.history.events[-1] if self.history.events else None
        moved = last is None or (last.lower_bound, last.upper_bound) != (
            event.lower_bound, event.upper_bound
        )  # fmt: skip
        if moved or kind == "end":
            self.history.events.append(event)

    def solution(self, **extra: float) -> Solution:
        """Return the result in the units of the instance."""
        assert self.status is not None
        area = self.reduced.area
        return Solution(
            self.status,
            self.reduced.pose(),
            lower_bound=self.lower_bound * area,
            upper_bound=self.upper_bound * area,
            gap_tol=self.gap_tol * area,
            certificate_scope=SCOPE,
            counters={"n_nodes": self.n_nodes, "n_assignments": self.n_spent},
            trace=self.history.rows(),
            extra={**extra, "n_dimensions": float(self.dim)},
        )


@dataclass
class Coordinates:
    """Affine coordinates z of the statistics of matchings: ``u = origin + axes z``.

    Statistics, and combinations of them, that are equal for all matchings are left out: the flat
    directions of the convex hull. An example is the sum of x if every source point is matched.

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

    It offers every matching to the incumbent. Points are ``u(P)``, or ``(u, L)(P)``.
    """

    def __init__(self, incumbent: Incumbent, with_fixed: bool = False) -> None:
        self.clouds, self.incumbent, self.with_fixed = incumbent.clouds, incumbent, with_fixed
        self.n_assignments = 0
        self.points: list[np.ndarray] = []

    @property
    def dim(self) -> int:
        return N_STATISTICS + self.with_fixed

    def least(self, direction: np.ndarray) -> np.ndarray:
        """Return the point that minimises ``direction . point``.

        The first assignment, which gives the first incumbent, is solved even if the time is over.
        """
        if self.incumbent.budget.is_over and np.isfinite(self.incumbent.value):
            raise OutOfTimeError
        fixed_weight = float(direction[-1]) if self.with_fixed else 0.0
        weights = np.ascontiguousarray(direction[:N_STATISTICS])
        _, col_of = minimum_linear(self.clouds, weights, fixed_weight)
        self.n_assignments += 1
        u, fixed = statistics(self.clouds, col_of)
        if self.incumbent.beaten_by(fixed + concave(self.clouds, u)):
            self.incumbent.offer(col_of)
        point = np.append(u, fixed) if self.with_fixed else u
        self.points.append(point)
        return point

    def coordinates(self) -> Coordinates:
        """Return coordinates of the affine hull of all points, each scaled to [0, 1]."""
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
        if basis.shape[1] == len(moving):  # the basis consists of coordinates, with known ranges
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
        """Return orthonormal columns that span all differences of points (in scaled coordinates)."""
        full = np.eye(len(moving))
        while len(moving):
            spread = (np.array(self.points)[:, moving] - self.points[0][moving]) / scale
            _, singular, vt = np.linalg.svd(spread)
            rank = int((singular > _FLAT).sum())
            if rank == len(moving):
                return full
            for row in vt[rank:]:  # flat so far: compute its extremes
                direction = np.zeros(self.dim)
                direction[moving] = row / scale
                if (self.least(-direction) - self.least(direction)) @ direction > _FLAT:
                    break  # not flat: continue with the new points
            else:
                return vt[:rank].T
        return full
