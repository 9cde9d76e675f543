"""The objectives that certificates speak of, with plain bounds on them: NumPy and SciPy alone.

For each family of poses: the objective E(theta), a region that holds all its minimisers, and three
lower bounds over boxes of parameters. In all of them `needed` is the bound that a box has to reach; a
method may stop when it is reached.
"""

from __future__ import annotations

import abc

import numpy as np

from dcreg.certificate.format import CertificateError
from dcreg.certificate.line import Line
from dcreg.certificate.prices import Prices, Profile, cheapest_pairs, prices_of, sum_of_smallest


def _sum_of(cost: np.ndarray, columns: np.ndarray) -> float:
    return float(cost[np.arange(len(cost)), columns].sum())


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
    is_uniform : bool
        Whether a tangent misses the same of every matching, so that a `Profile` is one number.
    n_at_once : int
        Boxes to be treated at once: more share NumPy's overhead, fewer share prices sooner.
    n_assignments : int
        Assignments solved so far.
    """

    scope: str
    weights: np.ndarray
    is_sorted_order = False
    is_uniform = False
    n_at_once = 64

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
        self._profiles: dict[bytes, Profile] = {}
        self.prepare()
        self._prices = Prices(self.weights, len(target))

    @abc.abstractmethod
    def prepare(self) -> None:
        """Set `weights` and whatever else is computed once."""

    # --- the objective and where to look for its minimum

    @abc.abstractmethod
    def costs(self, theta: np.ndarray) -> np.ndarray:
        """(n, m) squared distances."""

    def objective(self, theta: np.ndarray) -> float:
        """E(theta), exactly."""
        return self.match(self.costs(theta))

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
    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """The k least distances of a point to its nearest target, each at its own best theta."""

    @abc.abstractmethod
    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """(n, m) least squared distances over one box."""

    def interval_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """The k cheapest one-to-one pairs, the distance of each at its own best theta of the box."""
        return np.array(
            [self.match(self.interval_costs(*box)) for box in zip(lower, upper, strict=True)]
        )

    def curvature(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """(B, ...) what rebates in B boxes depend on; they need only hold where E is below `needed`."""
        return np.zeros(len(lower))

    @abc.abstractmethod
    def rebates(self, step: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """(B, V, n) what a tangent at theta0 misses of the objective at ``theta0 + step``, (B, V, d).

        A squared distance is a quadratic in theta less a convex function. The tangent of the quadratic
        at theta0 misses ``R_i(step)`` of it, the same for every target. Where the family is uniform:
        (B, V, 1), the sum over k points.
        """

    def tangent_terms(
        self, rows: np.ndarray, totals: np.ndarray, rebates: np.ndarray
    ) -> np.ndarray:
        """(...) lower bounds on the objective less its rebates, by profiles (..., r) and (...)."""
        return sum_of_smallest(rows - rebates, 1 if self.is_uniform else self.k) - totals

    # --- the objective at parameters that several boxes share

    def least(self, thetas: np.ndarray, needed: float = np.inf) -> np.ndarray:
        """Lower bounds on E at (B, dim) parameters without assignments; no higher than `needed` helps."""
        return np.zeros(len(thetas))

    def match(self, cost: np.ndarray) -> float:
        """The k cheapest feasible pairs; costs are not negative."""
        self.n_assignments += 1
        cost, columns = cheapest_pairs(self._allowed(cost), self.k)
        return _sum_of(cost, columns)

    def _allowed(self, cost: np.ndarray) -> np.ndarray:
        """Costs at which one other pair costs more than k feasible ones."""
        if self.feasible is None:
            return cost
        return np.where(self.feasible, cost, 1.0 + self.k * cost.max())

    def known(self, thetas: np.ndarray) -> list[Profile]:
        """The best profiles so far at (B, dim) parameters; new ones by the prices of neighbours."""
        keys = [theta.tobytes() for theta in thetas]
        new = {
            key: theta for key, theta in zip(keys, thetas, strict=True) if key not in self._profiles
        }
        if new:
            estimates = self._estimates(np.array(list(new.values())))
            self._profiles.update(zip(new, estimates, strict=True))
        return [self._profiles[key] for key in keys]

    def solved(self, theta: np.ndarray) -> Profile:
        """The exact profile, computed once; its prices serve the neighbours."""
        key = theta.tobytes()
        if key not in self._profiles or not self._profiles[key].is_exact:
            self._profiles[key] = self._solve(theta)
        return self._profiles[key]

    def _estimates(self, thetas: np.ndarray) -> list[Profile]:
        return [
            self._profile(self._allowed(self.costs(theta)), self._prices.near(theta), False)
            for theta in thetas
        ]

    def _solve(self, theta: np.ndarray) -> Profile:
        self.n_assignments += 1
        cost = self._allowed(self.costs(theta))
        wide, columns = cheapest_pairs(cost, self.k)
        prices = prices_of(wide, columns)[: cost.shape[1]]
        self._prices.add(theta, prices)
        if self.is_uniform:
            return Profile(np.array([_sum_of(wide, columns)]), 0.0, True)
        return self._profile(cost, prices, True)

    def _profile(self, cost: np.ndarray, prices: np.ndarray, is_exact: bool) -> Profile:
        rows = (cost + prices).min(axis=1)
        if self.is_uniform:
            rows = sum_of_smallest(rows, self.k)[None]
        return Profile(rows, float(np.broadcast_to(prices, cost.shape[1:]).sum()), is_exact)

    def refute(self, thetas: np.ndarray, bounds: np.ndarray, leaves: np.ndarray) -> None:
        """Refuse the certificate if E at one of B parameters lies below the bound of its leaf."""
        if not len(thetas):
            return
        for at in np.flatnonzero(~(self.least(thetas, bounds.max()) >= bounds)):
            theta, bound = thetas[at], bounds[at]
            value = self.objective(theta)
            if value < bound:
                raise CertificateError(
                    f"leaf {leaves[at]}: its bound is false: "
                    f"theta {np.array2string(theta, precision=6)} "
                    f"has the objective {value:.9g}, below {bound:.9g}"
                )


class Similarity2D(Family):
    """theta = (a, b, u, v) moves x, as a complex number, to ``(a + ib) x + (u + iv)``."""

    scope = "over all similarity poses of the stated scales"

    def prepare(self) -> None:
        self.z = self.source[:, 0] + 1j * self.source[:, 1]
        spread = np.sqrt((self.source**2).sum(axis=1).mean())
        self.weights = np.array([spread, spread, 1.0, 1.0])
        self.is_uniform = self.k == len(self.z)
        ones = np.ones((len(self.z), 1))
        # |turn x + shift|^2 is linear in these numbers of a point
        self.moments = np.hstack([(self.source**2).sum(axis=1, keepdims=True), self.source, ones]).T
        if self.is_uniform:  # the sum over all points
            self.moments = self.moments.sum(axis=1, keepdims=True)

    def costs(self, theta: np.ndarray) -> np.ndarray:
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

    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """The nearest target of each source point or, where that is not enough, the other way round."""
        out = np.empty(len(lower))
        for box in range(len(lower)):
            cost = self.interval_costs(lower[box], upper[box])
            out[box] = sum_of_smallest(cost.min(axis=1), self.k)
            if out[box] < needed:
                out[box] = max(out[box], sum_of_smallest(cost.min(axis=0), self.k))
        return out

    def rebates(self, step: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """R_i = |turn x_i + shift|^2."""
        a, b, u, v = np.moveaxis(step, -1, 0)
        factors = [a * a + b * b, 2 * (u * a + v * b), 2 * (v * a - u * b), u * u + v * v]
        return np.stack(factors, axis=-1) @ self.moments


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
        self.is_uniform = True
        # or some: no assignments either, and so no prices
        is_on_line = self.feasible is None and not self.is_sorted_order
        self._line = Line(self.sorted_norms, n, self.k) if is_on_line else None
        if self.feasible is None:
            self.n_at_once = min(1024, max(64, 2**17 // n))

    def costs(self, theta: np.ndarray) -> np.ndarray:
        return (np.linalg.norm(self.source + theta, axis=1)[:, None] - self.norms) ** 2

    def objective(self, theta: np.ndarray) -> float:
        return (
            float(self.least(theta[None])[0]) if self.is_sorted_order else super().objective(theta)
        )

    def least(self, thetas: np.ndarray, needed: float = np.inf) -> np.ndarray:
        if self.feasible is not None:
            return super().least(thetas)
        moved = np.sort(self._norm_ranges(thetas, thetas)[0], axis=-1)
        if self._line is not None:
            return self._line.bounds(moved, moved, needed)
        return ((moved - self.sorted_norms) ** 2).sum(axis=-1)

    def _estimates(self, thetas: np.ndarray) -> list[Profile]:
        if self.feasible is not None:
            return super()._estimates(thetas)
        return [Profile(value, 0.0, True) for value in self.least(thetas)[:, None]]

    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """A minimiser is stationary: t is the mean of |y| u - x over the pairs, u unit vectors."""
        reach = -sum_of_smallest(-self.norms, self.k) / self.k
        low_x = sum_of_smallest(self.source.T, self.k) / self.k
        high_x = -sum_of_smallest(-self.source.T, self.k) / self.k
        return -reach - high_x, reach - low_x

    def _norm_ranges(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(..., n) least and greatest |x + t| over boxes (..., 3)."""
        near = far = np.zeros(1)
        for axis, x in enumerate(self.source.T):
            low, high = x + lower[..., axis, None], x + upper[..., axis, None]
            near = near + np.maximum(np.maximum(low, -high), 0.0) ** 2
            far = far + np.maximum(-low, high) ** 2
        return np.sqrt(near), np.sqrt(far)

    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        near, far = self._norm_ranges(lower, upper)
        outside = np.maximum(near[:, None] - self.norms, self.norms - far[:, None])
        return np.maximum(outside, 0.0) ** 2

    def interval_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """On a line the i-th norm in order lies between the i-th ends in order."""
        if self._line is None:
            return super().interval_bound(lower, upper, needed)
        near, far = self._norm_ranges(lower, upper)
        return self._line.bounds(np.sort(near, axis=1), np.sort(far, axis=1), needed)

    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        near, far = self._norm_ranges(lower, upper)
        edges = np.concatenate([[-np.inf], self.sorted_norms, [np.inf]])
        # the first norm not below the range's near end, and the last one before it
        at = np.searchsorted(self.sorted_norms, near)
        distance = np.minimum(near - edges[at], np.maximum(edges[at + 1] - far, 0.0))
        return sum_of_smallest(distance**2, self.k)

    def curvature(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """(B, 3, 3) matrices M: E of every matching that counts is concave in the box less |t|_M^2.

        Half the Hessian of (z - r)^2, with z = |x + t| and u its direction, is ``u u' + (z - r) / z
        (I - u u')``, at most I. In a ball of radius h about a box, u u' changes by h / z at most, and
        z - r by 2 h. What is left of z - r are the residuals somewhere in the box: for a matching that
        counts their squares add up to less than `needed`. Points too near for this to help take I.
        """
        centre = 0.5 * (lower + upper)
        radius = 0.5 * np.linalg.norm(upper - lower, axis=1, keepdims=True)
        moved = self.source + centre[:, None]
        z = np.linalg.norm(moved, axis=-1)
        is_far = z > 4.0 * radius
        inverse = np.divide(1.0, z, out=np.zeros_like(z), where=is_far)
        most = np.divide(1.0, z - radius, out=np.zeros_like(z), where=is_far)  # 1 / z in the ball
        turned = radius[:, 0] * (inverse + 2.0 * most).sum(axis=1)
        misfit = np.sqrt(np.nan_to_num(needed)) * np.linalg.norm(most, axis=1)
        directions = moved * inverse[..., None]
        found = directions.swapaxes(1, 2) @ directions
        least = (~is_far).sum(axis=1) + turned + misfit
        found += least[:, None, None] * np.eye(3)
        anywhere = self.k * np.eye(3)  # I for every pair
        helps = np.trace(found, axis1=1, axis2=2) < 3.0 * self.k
        return np.where(helps[:, None, None], found, anywhere)

    def rebates(self, step: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        return ((step @ curvature) * step).sum(axis=-1, keepdims=True)


FAMILIES: dict[str, type[Family]] = {"similarity2d": Similarity2D, "translation3d": Translation3D}
