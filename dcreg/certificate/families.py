"""The objectives that certificates speak of, with plain bounds on them: NumPy and SciPy alone.

For each family of poses: the objective E(theta), a region that holds all its minimisers, and three
lower bounds over boxes of parameters. In all of them `needed` is the bound that a box has to reach; a
method may stop when it is reached.
"""

from __future__ import annotations

import abc

import numpy as np
from scipy.optimize import linear_sum_assignment

from dcreg.certificate.format import CertificateError

MAX_DENSE = 4_000_000  # pairs of which cost matrices are formed


def cheapest_pairs(cost: np.ndarray, k: int) -> float:
    """The k cheapest pairs, one per row and column, of costs that are not negative."""
    cost = cost if cost.shape[0] <= cost.shape[1] else cost.T
    n_unmatched = cost.shape[0] - k
    if n_unmatched:  # free columns for the rows that stay without a partner
        cost = np.hstack([cost, np.zeros((cost.shape[0], n_unmatched))])
    rows, columns = linear_sum_assignment(cost)
    return float(cost[rows, columns].sum())


def sum_of_smallest(values: np.ndarray, k: int) -> np.ndarray:
    """Sum of the k smallest along the last axis."""
    if k == values.shape[-1]:
        return values.sum(axis=-1)
    return np.partition(values, k - 1, axis=-1)[..., :k].sum(axis=-1)


class Family(abc.ABC):
    """An objective ``E(theta)``: the k cheapest pairs of squared feature distances.

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
        What a proof over this family speaks of.
    weights : (dim,) array
        RMS motion of the source per unit step along each axis of theta.
    is_sorted_order : bool
        Whether matching in sorted order is optimal, so that no cost matrix is needed.
    n_assignments : int
        Assignments solved so far.
    """

    scope: str
    weights: np.ndarray
    is_sorted_order = False

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        k: int,
        scale_range: tuple[float, float],
        feasible: np.ndarray | None = None,
    ) -> None:
        self.source = source
        self.target = target
        self.k = k
        self.scale_range = scale_range
        self.feasible = feasible
        self.n_assignments = 0
        self._known: dict[bytes, tuple[float, bool]] = {}
        self.prepare()

    @abc.abstractmethod
    def prepare(self) -> None:
        """Set `weights` and whatever else is computed once."""

    # --- the objective and where to look for its minimum

    @abc.abstractmethod
    def objective(self, theta: np.ndarray) -> float:
        """E(theta), exactly."""

    @abc.abstractmethod
    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a box outside of which no minimiser lies."""

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        """Which of (B, dim) parameters are poses of the family."""
        return np.ones(len(thetas), dtype=bool)

    def outside(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Which of B boxes surely hold no admissible parameter."""
        return np.zeros(len(lower), dtype=bool)

    # --- bounds over B boxes

    @abc.abstractmethod
    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray) -> np.ndarray:
        """The k least distances of a point to its nearest target, each at its own best theta."""

    @abc.abstractmethod
    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """(n, m) least squared distances over one box; None where too large to be formed."""

    def interval_bound(
        self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray
    ) -> np.ndarray:
        """The k cheapest one-to-one pairs, the distance of each at its own best theta of the box."""
        out = np.zeros(len(lower))
        for box in range(len(lower)):
            cost = self.interval_costs(lower[box], upper[box])
            if cost is not None:
                out[box] = self.match(cost)
        return out

    @abc.abstractmethod
    def tangent_loss(self, step: np.ndarray) -> np.ndarray:
        """How far the tangent bound at theta0 may fall short of the objective at ``theta0 + step``.

        A squared distance is a quadratic in theta less a convex function. The tangent of the quadratic
        at theta0 misses ``R_i(step)`` of it, the same for every target: at most the sum of the k largest
        R_i. Over the last axis of `step`.
        """

    def exact_tangent_bound(
        self, vertices: np.ndarray, values: np.ndarray, base: np.ndarray, needed: float
    ) -> float:
        """The tangent bound of one box from the loss of the points matched, not of the k largest.

        Parameters
        ----------
        vertices : (V, dim) array
        values : (V,) array
            The objective there, or lower bounds on it.
        base : (dim,) array
            Where the tangent is taken.
        needed : float
        """
        return float((values - self.tangent_loss(vertices - base)).min())

    # --- the objective at parameters that several boxes share

    def match(self, cost: np.ndarray) -> float:
        """The k cheapest feasible pairs; costs are not negative."""
        self.n_assignments += 1
        if self.feasible is not None:  # one other pair costs more than k feasible ones
            cost = np.where(self.feasible, cost, 1.0 + self.k * cost.max())
        return cheapest_pairs(cost, self.k)

    def estimate(self, theta: np.ndarray) -> tuple[float, bool]:
        """A cheap lower bound on the objective, and whether it is exact."""
        return float(self.nearest_bound(theta[None], theta[None], np.array([np.inf]))[0]), False

    def known(self, theta: np.ndarray) -> tuple[float, bool]:
        """The best lower bound on the objective so far, and whether it is exact."""
        key = theta.tobytes()
        if key not in self._known:
            self._known[key] = self.estimate(theta)
        return self._known[key]

    def remembered_objective(self, theta: np.ndarray) -> float:
        """E(theta), computed once."""
        key = theta.tobytes()
        if not self._known.get(key, (0.0, False))[1]:
            self._known[key] = self.objective(theta), True
        return self._known[key][0]

    def refute(self, theta: np.ndarray, bound: float, owner: str) -> None:
        """Refuse the certificate if the objective at `theta` lies below a bound of its `owner`."""
        value = self.remembered_objective(theta)
        if value < bound:
            raise CertificateError(
                f"{owner}: its bound is false: theta {np.array2string(theta, precision=6)} "
                f"has the objective {value:.9g}, below {bound:.9g}"
            )


class Similarity2D(Family):
    """theta = (a, b, u, v) moves x, as a complex number, to ``(a + ib) x + (u + iv)``."""

    scope = "over all similarity poses of the stated scales"

    def prepare(self) -> None:
        self.z = self.source[:, 0] + 1j * self.source[:, 1]
        spread = np.sqrt((self.source**2).sum(axis=1).mean())
        self.weights = np.array([spread, spread, 1.0, 1.0])

    def objective(self, theta: np.ndarray) -> float:
        return self.match(self._costs(theta))

    def _costs(self, theta: np.ndarray) -> np.ndarray:
        """(n, m) squared distances."""
        moved = (theta[0] + 1j * theta[1]) * self.z + (theta[2] + 1j * theta[3])
        dx = moved.real[:, None] - self.target[:, 0]
        dy = moved.imag[:, None] - self.target[:, 1]
        return dx * dx + dy * dy

    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """The best translation is (mean of matched y) - s R (mean of matched x)."""
        high = self.scale_range[1]
        # |mean of k points| is at most the mean of the k largest norms, and at most its largest
        # projection on N directions / cos(pi / N), for any N
        reach = high * -sum_of_smallest(-np.abs(self.z), self.k) / self.k
        for count in (64, 1024):
            angle = 2 * np.pi / count * np.arange(count)
            projected = self.source @ np.array([np.cos(angle), np.sin(angle)])
            means = -sum_of_smallest(-projected.T, self.k) / self.k
            reach = min(reach, high * max(means.max(), 0.0) / np.cos(np.pi / count))
        low_y = sum_of_smallest(self.target.T, self.k) / self.k
        high_y = -sum_of_smallest(-self.target.T, self.k) / self.k
        return (
            np.concatenate([[-high, -high], low_y - reach]),
            np.concatenate([[high, high], high_y + reach]),
        )

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        low, high = self.scale_range
        scale = np.hypot(thetas[:, 0], thetas[:, 1])
        return (scale >= low * (1 - 1e-12)) & (scale <= high * (1 + 1e-12))

    def outside(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        low, high = self.scale_range
        lower, upper = lower[:, :2], upper[:, :2]
        nearest = np.linalg.norm(np.clip(0.0, lower, upper), axis=1)
        farthest = np.linalg.norm(np.maximum(np.abs(lower), np.abs(upper)), axis=1)
        return (nearest > high) | (farthest < low)

    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        moved = (centre[0] + 1j * centre[1]) * self.z + (centre[2] + 1j * centre[3])
        x, y = np.abs(self.source.T)
        half_x, half_y = half[0] * x + half[1] * y + half[2], half[0] * y + half[1] * x + half[3]
        dx = np.abs(moved.real[:, None] - self.target[:, 0]) - half_x[:, None]
        dy = np.abs(moved.imag[:, None] - self.target[:, 1]) - half_y[:, None]
        return np.maximum(dx, 0.0) ** 2 + np.maximum(dy, 0.0) ** 2

    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray) -> np.ndarray:
        """The nearest target of each source point or, where that is not enough, the other way round."""
        out = np.empty(len(lower))
        for box in range(len(lower)):
            cost = self.interval_costs(lower[box], upper[box])
            out[box] = sum_of_smallest(cost.min(axis=1), self.k)
            if out[box] < needed[box]:
                out[box] = max(out[box], sum_of_smallest(cost.min(axis=0), self.k))
        return out

    def tangent_loss(self, step: np.ndarray) -> np.ndarray:
        turn, shift = step[..., 0] + 1j * step[..., 1], step[..., 2] + 1j * step[..., 3]
        if self.k == len(self.z):  # the sum over all points, expanded
            size = (np.abs(self.z) ** 2).sum()
            cross = (np.conj(shift) * turn * self.z.sum()).real
            return np.abs(turn) ** 2 * size + 2 * cross + self.k * np.abs(shift) ** 2
        return -sum_of_smallest(-self._curvature(turn, shift), self.k)

    def _curvature(self, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """(..., n) R_i = |turn x_i + shift|^2, in real arithmetic for speed."""
        x, y = self.source.T
        u = turn.real[..., None] * x - turn.imag[..., None] * y + shift.real[..., None]
        v = turn.imag[..., None] * x + turn.real[..., None] * y + shift.imag[..., None]
        return u * u + v * v

    def exact_tangent_bound(
        self, vertices: np.ndarray, values: np.ndarray, base: np.ndarray, needed: float
    ) -> float:
        """Per vertex the least sum of ``E_ij - R_i`` over matchings; helps when points stay unmatched."""
        step = vertices - base
        bounds = values - self.tangent_loss(step)
        if self.k == len(self.z):
            return float(bounds.min())
        lost = self._curvature(step[:, 0] + 1j * step[:, 1], step[:, 2] + 1j * step[:, 3])
        for at in np.argsort(bounds):
            if bounds[at] >= needed:
                break
            # adding a constant to all pairs keeps the costs from being negative; it is paid k times
            most = lost[at].max()
            cost = self._costs(vertices[at]) + (most - lost[at])[:, None]
            bounds[at] = self.match(cost) - self.k * most
            if bounds[at] < needed:  # this box has to be divided anyway
                break
        return float(bounds.min())


class Translation3D(Family):
    """theta = t; matched are the norms ``|x + t|`` and ``|y|``."""

    scope = "over all translations, between norms about the target's centre"

    def prepare(self) -> None:
        self.norms = np.linalg.norm(self.target, axis=1)
        self.sorted_norms = np.sort(self.norms)
        self.weights = np.ones(3)
        n, m = len(self.source), len(self.target)
        # numbers on a line, all of them matched
        self.is_sorted_order = self.feasible is None and n == m == self.k

    def objective(self, theta: np.ndarray) -> float:
        moved = np.linalg.norm(self.source + theta, axis=1)
        if self.is_sorted_order:
            return float(((np.sort(moved) - self.sorted_norms) ** 2).sum())
        return self.match((moved[:, None] - self.norms) ** 2)

    def estimate(self, theta: np.ndarray) -> tuple[float, bool]:
        if self.is_sorted_order:
            return self.objective(theta), True
        return super().estimate(theta)

    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """A minimiser is stationary: t is the mean of |y| u - x over the pairs, u unit vectors."""
        reach = -sum_of_smallest(-self.norms, self.k) / self.k
        low_x = sum_of_smallest(self.source.T, self.k) / self.k
        high_x = -sum_of_smallest(-self.source.T, self.k) / self.k
        return -reach - high_x, reach - low_x

    def _norm_ranges(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(..., n) least and greatest |x + t| over boxes (..., 3)."""
        low, high = self.source + lower[..., None, :], self.source + upper[..., None, :]
        near = np.linalg.norm(np.clip(0.0, low, high), axis=-1)
        return near, np.linalg.norm(np.maximum(np.abs(low), np.abs(high)), axis=-1)

    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        if len(self.source) * len(self.norms) > MAX_DENSE:
            return None
        near, far = self._norm_ranges(lower, upper)
        outside = np.maximum(near[:, None] - self.norms, self.norms - far[:, None])
        return np.maximum(outside, 0.0) ** 2

    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray) -> np.ndarray:
        near, far = self._norm_ranges(lower, upper)
        edges = np.concatenate([[-np.inf], self.sorted_norms, [np.inf]])
        # the first norm not below the range's near end, and the last one before it
        at = np.searchsorted(self.sorted_norms, near)
        distance = np.minimum(near - edges[at], np.maximum(edges[at + 1] - far, 0.0))
        return sum_of_smallest(distance**2, self.k)

    def tangent_loss(self, step: np.ndarray) -> np.ndarray:
        return self.k * (step**2).sum(axis=-1)


FAMILIES: dict[str, type[Family]] = {"similarity2d": Similarity2D, "translation3d": Translation3D}
