"""The objectives that certificates refer to, with simple bounds on them, in NumPy and SciPy only."""

from __future__ import annotations

import numpy as np

from dcreg.certificate.assignment import Line, Profile, sum_of_smallest
from dcreg.certificate.objective import Objective
from dcreg.certificate.rigid import RigidPoses


class Similarity2D(Objective):
    """theta = (a, b, u, v) moves x, as a complex number, to ``(a + ib) x + (u + iv)``."""

    def prepare(self) -> None:
        low, high = map(float, self.scale_range)
        self.scope = f"over all similarity poses with scales from {low!r} to {high!r}"
        self.z = self.source[:, 0] + 1j * self.source[:, 1]
        spread = np.sqrt((self.source**2).sum(axis=1).mean())
        self.weights = np.array([spread, spread, 1.0, 1.0])
        self.is_uniform = self.k == len(self.z)
        ones = np.ones((len(self.z), 1))
        # |(a + ib) x + (u + iv)|^2 is linear in these moments of a point
        self.moments = np.hstack([(self.source**2).sum(axis=1, keepdims=True), self.source, ones]).T
        if self.is_uniform:  # their sum over all points
            self.moments = self.moments.sum(axis=1, keepdims=True)

    def costs(self, theta: np.ndarray) -> np.ndarray:
        moved = (theta[0] + 1j * theta[1]) * self.z + (theta[2] + 1j * theta[3])
        dx = moved.real[:, None] - self.target[:, 0]
        dy = moved.imag[:, None] - self.target[:, 1]
        return dx * dx + dy * dy

    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the region; the optimal translation is (mean of matched y) - s R (mean of matched x)."""
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
        """Bound by the nearest target of each source point or, if necessary, the nearest source point."""
        out = np.empty(len(lower))
        for box in range(len(lower)):
            cost = self.interval_costs(lower[box], upper[box])
            out[box] = sum_of_smallest(cost.min(axis=1), self.k)
            if out[box] < needed:
                out[box] = max(out[box], sum_of_smallest(cost.min(axis=0), self.k))
        return out

    def linearisation_gaps(self, step: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """Return ``R_i = |(a + ib) x_i + (u + iv)|^2`` of each step (a, b, u, v)."""
        a, b, u, v = np.moveaxis(step, -1, 0)
        factors = [a * a + b * b, 2 * (u * a + v * b), 2 * (v * a - u * b), u * u + v * v]
        return np.stack(factors, axis=-1) @ self.moments


class Translation3D(Objective):
    """theta = t; the norms ``|x + t|`` and ``|y|`` are matched."""

    scope = "over all translations, between norms about the target's centre"

    def prepare(self) -> None:
        self.norms = np.linalg.norm(self.target, axis=1)
        self.sorted_norms = np.sort(self.norms)
        self.weights = np.ones(3)
        n, m = len(self.source), len(self.target)
        # all numbers on a line match: sorting is optimal
        self.is_sorted_order = self.feasible is None and n == m == self.k
        self.is_uniform = True
        # some of them match: no assignments either, and so no duals
        is_on_line = self.feasible is None and not self.is_sorted_order
        self._line = Line(self.sorted_norms, n, self.k) if is_on_line else None
        if self.feasible is None:
            self.n_at_once = min(1024, max(64, 2**17 // n))

    def costs(self, theta: np.ndarray) -> np.ndarray:
        return (np.linalg.norm(self.source + theta, axis=1)[:, None] - self.norms) ** 2

    def value(self, theta: np.ndarray) -> float:
        if self.is_sorted_order:
            return float(self.lower_bounds(theta[None])[0])
        return super().value(theta)

    def lower_bounds(self, thetas: np.ndarray, needed: float = np.inf) -> np.ndarray:
        if self.feasible is not None:
            return super().lower_bounds(thetas)
        moved = np.sort(self._norm_ranges(thetas, thetas)[0], axis=-1)
        if self._line is not None:
            return self._line.bounds(moved, moved, needed)
        return ((moved - self.sorted_norms) ** 2).sum(axis=-1)

    def _estimates(self, thetas: np.ndarray) -> list[Profile]:
        if self.feasible is not None:
            return super()._estimates(thetas)
        return [Profile(value, 0.0, True) for value in self.lower_bounds(thetas)[:, None]]

    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the region; a minimiser t is a mean of |y| u - x over the pairs, with unit vectors u."""
        reach = -sum_of_smallest(-self.norms, self.k) / self.k
        low_x = sum_of_smallest(self.source.T, self.k) / self.k
        high_x = -sum_of_smallest(-self.source.T, self.k) / self.k
        return -reach - high_x, reach - low_x

    def _norm_ranges(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the (..., n) minima and maxima of |x + t| over boxes (..., 3)."""
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
        """Bound by pairs on a line: the i-th smallest norm lies between the i-th smallest ends."""
        if self._line is None:
            return super().interval_bound(lower, upper, needed)
        near, far = self._norm_ranges(lower, upper)
        return self._line.bounds(np.sort(near, axis=1), np.sort(far, axis=1), needed)

    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        near, far = self._norm_ranges(lower, upper)
        edges = np.concatenate([[-np.inf], self.sorted_norms, [np.inf]])
        # the first norm not below the near end of the range, and the last one before it
        at = np.searchsorted(self.sorted_norms, near)
        distance = np.minimum(near - edges[at], np.maximum(edges[at + 1] - far, 0.0))
        return sum_of_smallest(distance**2, self.k)

    def curvature(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """Return (B, 3, 3) matrices M such that E - |t|_M^2 is concave in the box for relevant matchings.

        With z = |x + t| and its direction u, half the Hessian of (z - r)^2 is ``u u' + (z - r) / z
        (I - u u')``, at most I. In a ball of radius h around a box, u u' changes by at most h / z and
        z - r by 2 h. The rest of z - r is the residual at some point of the box. A matching is relevant
        if its squared residuals there sum to less than `needed`. Points near the ball take I.
        """
        centre = 0.5 * (lower + upper)
        radius = 0.5 * np.linalg.norm(upper - lower, axis=1, keepdims=True)
        moved = self.source + centre[:, None]
        z = np.linalg.norm(moved, axis=-1)
        is_far = z > 4.0 * radius
        inverse = np.divide(1.0, z, out=np.zeros_like(z), where=is_far)
        largest_inverse = np.divide(
            1.0, z - radius, out=np.zeros_like(z), where=is_far
        )  # maximum of 1 / z in the ball
        rotation = radius[:, 0] * (inverse + 2.0 * largest_inverse).sum(axis=1)
        misfit = np.sqrt(np.nan_to_num(needed)) * np.linalg.norm(largest_inverse, axis=1)
        directions = moved * inverse[..., None]
        found = directions.swapaxes(1, 2) @ directions
        isotropic = (~is_far).sum(axis=1) + rotation + misfit
        found += isotropic[:, None, None] * np.eye(3)
        anywhere = self.k * np.eye(3)  # I for every pair
        helps = np.trace(found, axis1=1, axis2=2) < 3.0 * self.k
        return np.where(helps[:, None, None], found, anywhere)

    def linearisation_gaps(self, step: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        return ((step @ curvature) * step).sum(axis=-1, keepdims=True)


OBJECTIVES: dict[str, type[Objective]] = {
    "similarity2d": Similarity2D,
    "translation3d": Translation3D,
    "rigid3d": RigidPoses,
}
