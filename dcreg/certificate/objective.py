"""What the check of a certificate needs from an objective, in NumPy and SciPy only.

Each family of poses has an objective E(theta), a region that contains all its minimisers, and lower
bounds over boxes of parameters. The argument `needed` is the bound that a box has to reach; the
computation may stop there.
"""

from __future__ import annotations

import abc

import numpy as np

from dcreg.certificate.assignment import (
    DualCache,
    Profile,
    cheapest_pairs,
    duals_of,
    sum_of_smallest,
)
from dcreg.certificate.format import Certificate, CertificateError


def _sum_of(cost: np.ndarray, columns: np.ndarray) -> float:
    return float(cost[np.arange(len(cost)), columns].sum())


class Objective(abc.ABC):
    """An objective ``E(theta)``: the sum of the k cheapest one-to-one squared distances.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
        Normalised points.
    k : int
        Pairs to match.
    scale_range : (low, high)
    feasible : (n, m) bool array, optional
        The feasible pairs; default: all.

    Attributes
    ----------
    scope : str
        What a proof refers to.
    weights : (dim,) array
        RMS displacement of the source per unit step along each axis of theta.
    is_sorted_order : bool
        Whether matching in sorted order is optimal, so that no cost matrix is needed.
    is_uniform : bool
        Whether the linearisation gap is equal for every matching, so that a `Profile` is one number.
    n_at_once : int
        Boxes bounded at once. Larger batches amortise NumPy's overhead, smaller ones reuse duals earlier.
    n_assignments : int
        Assignments solved so far.
    only_optima : bool
        Whether the bounds of leaves hold for the optima in them, not for every parameter.
    boxes_per_leaf : int
        Typical maximum number of boxes per leaf that a proof needs.
    far : float
        Share of the bound needed. A box with a smaller bound is divided twice, because its halves are
        unlikely to be proven.
    rounding : float
        Rounding error of the bounds, if coordinates are larger than the normalised ones.
    area : float
        The squared unit of the clouds, for messages.
    largest_parameter : float
        No coordinate of an optimum exceeds it.
    """

    scope: str
    weights: np.ndarray
    is_sorted_order = False
    is_uniform = False
    n_at_once = 64
    only_optima = False
    boxes_per_leaf = 20
    far = 0.0
    rounding = 0.0
    area = 1.0

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        k: int,
        scale_range: tuple[float, float],
        feasible: np.ndarray | None = None,
    ) -> None:
        self.source, self.target, self.k = source, target, k
        self.scale_range, self.feasible = scale_range, feasible
        self.n_assignments = 0
        far_x, far_y = (float(np.linalg.norm(each, axis=1).max()) for each in (source, target))
        self.largest_parameter = scale_range[1] * (1.0 + far_x) + far_y
        self._profiles: dict[bytes, Profile] = {}
        self.prepare()
        self._duals = DualCache(self.weights, len(target))

    @abc.abstractmethod
    def prepare(self) -> None:
        """Set `weights` and compute everything that does not depend on theta."""

    # --- the objective and where to look for its minimum

    @abc.abstractmethod
    def costs(self, theta: np.ndarray) -> np.ndarray:
        """Return the (n, m) squared distances."""

    def value(self, theta: np.ndarray) -> float:
        """Return E(theta), exactly."""
        return self.match(self.costs(theta))

    @abc.abstractmethod
    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper ends of a box that contains every minimiser."""

    def roots(self, c: Certificate) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return the boxes that are divided into leaves: lower end, upper end, and their leaves."""
        return [(c.start_lower, c.start_upper, np.arange(len(c.leaf_bounds)))]

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        """Return which of (B, dim) parameters are admissible poses."""
        return np.ones(len(thetas), dtype=bool)

    def outside(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return which of B boxes certainly contain no admissible parameter."""
        return np.zeros(len(lower), dtype=bool)

    # --- bounds over B boxes

    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """Bound by the k smallest distances to the nearest target, each at its best theta of the box."""
        raise NotImplementedError

    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the (n, m) minimum squared distances over one box."""
        raise NotImplementedError

    def interval_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """Bound by the k cheapest one-to-one pairs, each at its best theta of the box."""
        return np.array(
            [self.match(self.interval_costs(*box)) for box in zip(lower, upper, strict=True)]
        )

    def curvature(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """Return (B, ...) curvatures for `linearisation_gaps`, valid where E is below `needed`."""
        return np.zeros(len(lower))

    def linearisation_gaps(self, step: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """Return (B, V, n) gaps between the objective and its linearisation at (B, V, d) steps.

        A squared distance is a quadratic in theta less a convex function. The tangent of the quadratic
        at theta0 is ``R_i(step)`` below it at ``theta0 + step``, for every target. If `is_uniform`, the
        result is (B, V, 1), the sum over k points.
        """
        raise NotImplementedError

    def tangent_terms(self, rows: np.ndarray, totals: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Return (...) lower bounds on the objective less its gaps, from profiles (..., r) and (...)."""
        return sum_of_smallest(rows - gaps, 1 if self.is_uniform else self.k) - totals

    def lower_bounds(self, thetas: np.ndarray, needed: float = np.inf) -> np.ndarray:
        """Return lower bounds on E at (B, dim) parameters without assignments, up to about `needed`."""
        return np.zeros(len(thetas))

    def match(self, cost: np.ndarray) -> float:
        """Return the cost of the k cheapest feasible pairs; costs are non-negative."""
        self.n_assignments += 1
        cost, columns = cheapest_pairs(self._allowed(cost), self.k)
        return _sum_of(cost, columns)

    def _allowed(self, cost: np.ndarray) -> np.ndarray:
        """Return costs at which one infeasible pair costs more than k feasible ones."""
        if self.feasible is None:
            return cost
        return np.where(self.feasible, cost, 1.0 + self.k * cost.max())

    def profiles(self, thetas: np.ndarray) -> list[Profile]:
        """Return the best profiles so far at (B, dim) parameters, new ones by the duals of neighbours."""
        keys = [theta.tobytes() for theta in thetas]
        new = {
            key: theta for key, theta in zip(keys, thetas, strict=True) if key not in self._profiles
        }
        if new:
            estimates = self._estimates(np.array(list(new.values())))
            self._profiles.update(zip(new, estimates, strict=True))
        return [self._profiles[key] for key in keys]

    def solved_profile(self, theta: np.ndarray) -> Profile:
        """Return the exact profile, computed once; its duals serve the neighbours."""
        key = theta.tobytes()
        if key in self._profiles and self._profiles[key].is_exact:
            return self._profiles[key]
        self.n_assignments += 1
        cost = self._allowed(self.costs(theta))
        wide, columns = cheapest_pairs(cost, self.k)
        duals = duals_of(wide, columns)[: cost.shape[1]]
        self._duals.add(theta, duals)
        if self.is_uniform:
            self._profiles[key] = Profile(np.array([_sum_of(wide, columns)]), 0.0, True)
        else:
            self._profiles[key] = self._profile(cost, duals, True)
        return self._profiles[key]

    def _estimates(self, thetas: np.ndarray) -> list[Profile]:
        return [
            self._profile(self._allowed(self.costs(theta)), self._duals.near(theta), False)
            for theta in thetas
        ]

    def _profile(self, cost: np.ndarray, duals: np.ndarray, is_exact: bool) -> Profile:
        rows = (cost + duals).min(axis=1)
        if self.is_uniform:
            rows = sum_of_smallest(rows, self.k)[None]
        return Profile(rows, float(np.broadcast_to(duals, cost.shape[1:]).sum()), is_exact)

    def refute(self, thetas: np.ndarray, bounds: np.ndarray, leaves: np.ndarray) -> None:
        """Refuse the certificate if E at one of B parameters lies below the bound of its leaf."""
        if not len(thetas):
            return
        for at in np.flatnonzero(~(self.lower_bounds(thetas, bounds.max()) >= bounds)):
            theta, bound = thetas[at], bounds[at]
            value = self.value(theta)
            if value < bound:
                raise CertificateError(
                    f"leaf {leaves[at]}: its bound is false: "
                    f"theta {np.array2string(theta, precision=6)} "
                    f"(in normalised coordinates) has the objective {value * self.area:.9g}, below "
                    f"{bound * self.area:.9g}"
                )
