"""The objective over rigid poses in 3D, with simple bounds on it, in NumPy only.

The smaller cloud moves: theta is a quaternion (w, x, y, z) of any length, then a translation t. The
quaternions are those of the four facets w, x, y, z = 1 of the cube [-1, 1]^4. A leaf is a box on one of
the facets times a box of translations. `docs/certificate.md` proves the bounds, which are

- spherical caps: a rotated point stays on a cap around its position at the centre of the box;
- displacements: an optimum is stationary, so its pairs cost little more at the centre of the box than
  the squares of their displacements to it; the same holds for the vertices of the box;
- Cayley's form, in which the residuals are linear in the pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dcreg.certificate.assignment import improve_duals, shortest_paths, sum_of_smallest
from dcreg.certificate.format import Certificate, require
from dcreg.certificate.objective import Objective
from dcreg.certificate.vectors import cross, matrices, plus_duals, squared_distances

WORTH_ASSIGNMENT = 0.7  # share of the bound needed from which the pairs of caps are assigned
FEW_PAIRS = 1000  # the search bounds boxes of so few by caps only
MAX_CELLS = 1 << 20  # costs held at once
N_STEPS = 16  # of the grid of `joint_loss`
BITS = (np.arange(8)[:, None] >> np.arange(3)) & 1
# For each facet, which coordinates of the quaternions are at their upper end at the 8 vertices.
ENDS = np.array([np.insert(BITS, axis, 0, axis=1) for axis in range(4)], dtype=bool)


class Boxes(NamedTuple):
    """B boxes of poses, relative to their centres.

    Attributes
    ----------
    centre : (B, 7) array
    gibbs : (B, 8, 3) array
        Gibbs vectors (axis times the tangent of half the angle) of the vertices.
    tangent : (B,) array
        Their maximum length; inf if one does not exist.
    half : (B, 3) array
        Half widths of the translations.
    shift : (B,) array
        Maximum length of a shift.
    """

    centre: np.ndarray
    gibbs: np.ndarray
    tangent: np.ndarray
    half: np.ndarray
    shift: np.ndarray

    def some(self, rows: np.ndarray | slice) -> Boxes:
        """Return some of the boxes."""
        return Boxes(*(value[rows] for value in self))


class Loss(NamedTuple):
    """How far the costs C of an optimum at other poses may exceed its objective E.

    ``E + root sqrt(E) + rest >= C``, with one pair of numbers for each of B boxes.
    """

    root: np.ndarray
    rest: np.ndarray

    def proven(self, cost: np.ndarray) -> np.ndarray:
        """Return the smallest E that is possible; 0 if there is none."""
        left = np.maximum(cost - self.rest, 0.0)
        return (0.5 * (np.sqrt(self.root * self.root + 4.0 * left) - self.root)) ** 2

    @property
    def doubled(self) -> Loss:
        """Twice the loss."""
        return Loss(2.0 * self.root, 2.0 * self.rest)

    def needed(self, bound: float) -> np.ndarray:
        """Return the C that proves a bound."""
        return bound + self.root * np.sqrt(bound) + self.rest


class RigidPoses(Objective):
    """theta = (w, x, y, z, t) moves a point x of the smaller cloud to R x + t."""

    scope = "over all rigid poses"
    only_optima = True
    boxes_per_leaf = 60
    n_at_once = 1 << 15

    def prepare(self) -> None:
        n, m, k = len(self.source), len(self.target), self.k
        squares = (self.source**2).sum(axis=1)
        # a unit step of a coordinate of the quaternion rotates by 1 to 2 radians
        self.weights = np.array([1.3 * np.sqrt(squares.mean())] * 4 + [1.0] * 3)
        self.inertia = -float(sum_of_smallest(-squares, k))  # maximum sum of |x|^2 over k points
        self.mean = _largest_mean(self.source, k)
        # at least the difference of two eigenvalues of the second moments of k points
        self.spread = float(np.linalg.eigvalsh(self.source.T @ self.source)[-1]) * (1.0 + 1e-12)
        self.radius = float(np.sqrt(squares.max()))
        self.farthest = float(np.linalg.norm(self.target, axis=1).max())
        reach = 2.0 * (self.radius + self.farthest)
        self.max_dual = reach**2
        self.rounding = 64.0 * np.finfo(float).eps * (k + m) * reach**2
        # any constant is valid; this one keeps infeasible pairs out of optimal matchings
        self.penalty = np.zeros((1, 1))
        if self.feasible is not None:
            self.penalty = np.where(self.feasible, 0.0, k * reach**2)
        self.has_few_pairs = n * m <= FEW_PAIRS
        self.n_costs = max(1, MAX_CELLS // (n * m))  # cost matrices held at once

    # --- the objective

    def costs(self, theta: np.ndarray) -> np.ndarray:
        moved = self.source @ matrices(theta[None, :4])[0].T + theta[4:]
        return ((moved[:, None] - self.target) ** 2).sum(axis=2)

    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the region; the optimal translation is (mean of matched y) - R (mean of matched x)."""
        low = sum_of_smallest(self.target.T, self.k) / self.k
        high = -sum_of_smallest(-self.target.T, self.k) / self.k
        return np.append(-np.ones(4), low - self.mean), np.append(np.ones(4), high + self.mean)

    def roots(self, c: Certificate) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return the four facets times the box of translations, with the leaves on them."""
        is_cube = (c.start_lower[:4] == -1.0).all() and (c.start_upper[:4] == 1.0).all()
        require(is_cube, "start box: the quaternions do not span the cube [-1, 1]^4")
        is_on = (c.leaf_lower[:, :4] == 1.0) & (c.leaf_upper[:, :4] == 1.0)
        stray = np.flatnonzero(is_on.sum(axis=1) != 1)
        require(
            not stray.size, f"leaves: leaf {stray[:1]} does not lie on one facet of quaternions"
        )
        roots = []
        for axis in range(4):
            lower = c.start_lower.copy()
            lower[axis] = 1.0
            leaves = np.flatnonzero(is_on[:, axis])
            require(leaves.size > 0, f"leaves: a gap: none on facet {axis} of quaternions")
            roots.append((lower, c.start_upper, leaves))
        return roots

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        """Return whether the quaternion has a direction."""
        return np.linalg.norm(thetas[:, :4], axis=1) > 0.1

    def lower_bounds(self, thetas: np.ndarray, needed: float = np.inf) -> np.ndarray:
        """Bound by the k smallest distances to the nearest target or, if necessary, by better duals.

        They come from an auction and, if these do not suffice, from an assignment. The next pose begins
        with them.
        """
        duals = np.zeros(len(self.target))
        out = self.values_from(thetas, np.zeros((len(thetas), len(duals))))
        for at in np.flatnonzero(out < needed):
            for exactly in (False, True):
                if out[at] < needed:
                    out[at], duals = self.improved(thetas[at], duals, exactly=exactly)
        return out

    def values_from(self, thetas: np.ndarray, duals: np.ndarray) -> np.ndarray:
        """Bound the objective at (B, 7) poses from below by (B, m) duals."""
        out = np.empty(len(thetas))
        for part in self.parts(len(thetas)):
            rows = self.costs_with(thetas[part], duals[part]).min(axis=2)
            out[part] = sum_of_smallest(rows, self.k) - duals[part].sum(axis=1, dtype=np.float64)
        return out - self.rounding

    def rough_values(self, thetas: np.ndarray, duals: np.ndarray) -> np.ndarray:
        """Bound as `values_from` at few poses, but sooner: in single precision, less its errors.

        A cost is a sum of five products of rounded numbers. Each term is rounded at most seven times, and
        the terms add up to at most ``(|x| + |y|)^2 + dual``.
        """
        if self.feasible is not None:  # the penalties are too large for single precision
            return self.values_from(thetas, duals)
        moved = self.moved(thetas)
        rows = plus_duals(moved, self.target, duals, np.float32).min(axis=2).astype(np.float64)
        reach = np.sqrt((moved**2).sum(axis=2).max(axis=1)) + self.farthest
        lost = 8.0 * 2.0**-24 * self.k * (reach**2 + duals.max(axis=1))
        total = duals.sum(axis=1, dtype=np.float64)
        return sum_of_smallest(rows, self.k) - total - lost - self.rounding

    def moved(self, thetas: np.ndarray) -> np.ndarray:
        """Return the (B, n, 3) source points at poses."""
        return self.source @ matrices(thetas[:, :4]).swapaxes(1, 2) + thetas[:, None, 4:]

    def costs_with(self, thetas: np.ndarray, duals: np.ndarray) -> np.ndarray:
        """Return (B, n, m) squared distances plus duals (B, m), at few poses (B, 7)."""
        costs = plus_duals(self.moved(thetas), self.target, duals)
        if self.feasible is not None:
            costs += self.penalty
        return costs

    def improved(
        self, theta: np.ndarray, duals: np.ndarray, *, exactly: bool = False
    ) -> tuple[float, np.ndarray]:
        """Return a lower bound on the objective at a pose, and the duals that prove it."""
        if exactly:
            costs = self.costs_with(theta[None], np.zeros((1, len(duals))))[0]
            value, duals = self.matched(costs)
            return value - self.rounding, duals
        values, better = self.auctioned(theta[None], duals[None])
        return float(values[0]), better[0]

    def auctioned(
        self, thetas: np.ndarray, duals: np.ndarray, goals: np.ndarray | float = np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return lower bounds at few poses (B, 7), up to about `goals`, and the duals that prove them."""
        costs = self.costs_with(thetas, np.zeros_like(duals))
        values, duals = improve_duals(costs, duals, self.k, goals + self.rounding)
        return values - self.rounding, duals

    def parts(self, count: int) -> Iterator[slice]:
        """Yield parts of `count` poses whose costs are held at once."""
        return (slice(at, at + self.n_costs) for at in range(0, count, self.n_costs))

    # --- bounds over boxes

    def cap_bound(self, boxes: Boxes, duals: np.ndarray, needed: float) -> np.ndarray:
        """Bound by spherical caps: nearest points of either cloud, or pairs if these may suffice."""
        costs = self.cap_costs(boxes)
        loss = self.k * boxes.shift**2
        bounds, plain = np.zeros(len(costs)), np.zeros(len(costs))
        for axis in (2, 1):
            nearest = costs.min(axis=axis)
            beyond = np.maximum(np.sqrt(nearest) - boxes.shift[:, None], 0.0)
            plain = np.maximum(plain, sum_of_smallest(nearest, self.k))
            bounds = np.maximum(bounds, sum_of_smallest(beyond**2, self.k))
        paired = sum_of_smallest((costs + duals[:, None]).min(axis=2), self.k) - duals.sum(
            axis=1, dtype=np.float64
        )
        bounds = np.maximum(bounds, np.maximum(plain, paired) - loss)
        is_worth = (bounds < needed) & (plain >= WORTH_ASSIGNMENT * (needed + loss))
        found, _ = improve_duals(
            costs[is_worth], duals[is_worth], self.k, (needed + loss)[is_worth]
        )
        bounds[is_worth] = np.maximum(bounds[is_worth], found - loss[is_worth])
        return bounds

    def matched(self, cost: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the sum of the k cheapest one-to-one pairs, and optimal duals of the columns."""
        self.n_assignments += 1
        return shortest_paths(cost, self.k)

    def match(self, cost: np.ndarray) -> float:
        return self.matched(self._allowed(cost))[0]

    def boxes(self, lower: np.ndarray, upper: np.ndarray) -> Boxes:
        """Express B boxes relative to their centres."""
        centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)[:, 4:]
        q = centre[:, None, :4]
        facet = np.argmin((upper - lower)[:, :4], axis=1)
        vertices = np.where(ENDS[facet], upper[:, None, :4], lower[:, None, :4])
        # vertex times the conjugate of the centre
        real = (vertices * q).sum(axis=2, keepdims=True)
        vector = q[..., :1] * vertices[..., 1:] - vertices[..., :1] * q[..., 1:]
        vector -= cross(vertices[..., 1:], q[..., 1:])
        exists = (real > 0.0).all(axis=(1, 2))
        gibbs = np.where(exists[:, None, None], vector / np.where(real > 0.0, real, 1.0), 0.0)
        tangent = np.where(exists, np.sqrt((gibbs**2).sum(axis=2).max(axis=1)), np.inf)
        return Boxes(centre, gibbs, tangent, half, np.sqrt((half**2).sum(axis=1)))

    def points(self, boxes: Boxes) -> tuple[np.ndarray, np.ndarray]:
        """Return the source rotated to the centres of boxes, and the target minus their translations."""
        moved = self.source @ matrices(boxes.centre[:, :4]).swapaxes(1, 2)
        return moved, self.target - boxes.centre[:, None, 4:]

    def cap_costs(self, boxes: Boxes) -> np.ndarray:
        """Return (B, n, m) squared distances between targets and the caps of source points.

        A point at the angle phi from the centre of a cap of angle w has the angle max(phi - w, 0) from
        the cap. The sine of phi is rounded up, so that the distance is rounded down.
        """
        moved, fixed = self.points(boxes)
        angle = 2.0 * np.arctan(boxes.tangent)[:, None, None]
        cos, sin = np.cos(angle), np.sin(angle)
        a = (moved**2).sum(axis=2)[:, :, None]
        b = (fixed**2).sum(axis=2)[:, None]
        inner = moved @ fixed.swapaxes(1, 2)
        length = np.sqrt(a) * np.sqrt(b)
        near = (a * (1.0 + 1e-14)) * b
        cost = inner * inner
        near -= cost
        np.maximum(near, 0.0, out=near)
        np.sqrt(near, out=near)
        near *= sin
        near += np.multiply(inner, cos, out=cost)
        np.multiply(length, cos, out=cost)
        np.copyto(near, length, where=inner >= cost)
        near *= -2.0
        np.add(a, b, out=cost)
        cost += near
        np.maximum(cost, 0.0, out=cost)
        if self.feasible is not None:
            cost += self.penalty
        return cost

    def displacements(self, boxes: Boxes) -> np.ndarray:
        """Return (B, 8, S, n) squares of ``2 r x x + s`` at the vertices (r, s) of the boxes."""
        turned = 2.0 * cross(boxes.gibbs[:, :, None], self.points(boxes)[0][:, None])
        shifts = _signed(boxes.half)[:, None]
        squares = 2.0 * (shifts @ turned.swapaxes(2, 3))
        squares += (turned**2).sum(axis=3)[:, :, None]
        squares += (shifts**2).sum(axis=3)[..., None]
        return squares

    def loss(self, boxes: Boxes) -> Loss:
        """Return the loss of the costs at the centre."""
        square = boxes.tangent**2
        return Loss(
            4.0 * square / (1.0 + square) * np.sqrt(self.inertia),
            4.0 * square / np.sqrt(1.0 + square) * boxes.shift * self.k * self.mean,
        )

    def joint_loss(self, boxes: Boxes) -> Loss:
        """Return the loss of the mean of the costs at the centre and at the vertices."""
        square = 2.0 * boxes.tangent**2
        drift = square * boxes.shift * self.k * self.mean
        spread, inertia = square * boxes.tangent * self.spread, 0.5 * square**2 * self.inertia
        u = np.linspace(0.0, 1.0, 1 + N_STEPS)
        rest = np.array([drift, spread, inertia]).T @ np.array([u**2, u - u**3, u**2 - u**4])
        beyond = (6.0 * spread + 10.0 * inertia) / (8.0 * N_STEPS**2)  # between points of the grid
        return Loss(square * np.sqrt(self.inertia), rest.max(axis=1) + beyond)

    def cayley_bound(self, boxes: Boxes, duals: np.ndarray, needed: float) -> np.ndarray:
        """Bound by Cayley's form, linearised at the best pose for the cheapest pairs at the centre."""
        moved, fixed = self.points(boxes)
        costs = squared_distances(moved, fixed) + self.penalty + duals[:, None]
        columns, rows = costs.argmin(axis=2), costs.min(axis=2)
        last = np.partition(rows, self.k - 1, axis=1)[:, self.k - 1, None]
        columns[rows > last] = len(self.target)  # not matched
        reach, h = np.abs(boxes.gibbs).max(axis=1), boxes.half
        half = h + np.roll(reach, -1, axis=1) * np.roll(h, -2, axis=1)
        half += np.roll(reach, -2, axis=1) * np.roll(h, -1, axis=1)
        turn, shift = _fit(moved, fixed, columns, has_shifts=bool(h.any()))
        turn, shift = np.clip(turn, -reach, reach), np.clip(shift, -half, half)
        moved, fixed = moved[:, :, None], fixed[:, None]
        both = moved + fixed
        residual = moved - fixed + shift[:, None, None] + cross(turn[:, None, None], both)
        torque = cross(both, residual)
        constant = (residual**2).sum(axis=3) + self.penalty + duals[:, None]
        minima = np.full(len(half), np.inf)
        for r in np.moveaxis(boxes.gibbs - turn[:, None], 1, 0):
            turned = constant + 2.0 * (torque @ r[:, None, :, None])[..., 0]
            for s in np.moveaxis(_signed(half) - shift[:, None], 1, 0):
                rows = (turned + 2.0 * (residual @ s[:, None, :, None])[..., 0]).min(axis=2)
                minima = np.minimum(minima, sum_of_smallest(rows, self.k))
        return np.maximum(minima - duals.sum(axis=1, dtype=np.float64), 0.0) / (
            1.0 + boxes.tangent**2
        )


def _fit(
    moved: np.ndarray, fixed: np.ndarray, columns: np.ndarray, *, has_shifts: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the r and s that minimise the sum of ``|x - y + s + r x (x + y)|^2`` over some pairs.

    Row i is paired with its column, unless there is no such column.
    """
    m = fixed.shape[1]
    matched = (columns < m)[:, :, None]
    y = np.take_along_axis(fixed, np.minimum(columns, m - 1)[:, :, None], axis=1)
    both, off = (moved + y) * matched, (moved - y) * matched
    eye = np.eye(3)
    turned = cross(eye[:, None], both[:, None])  # (B, 3, n, 3): for each unit vector r
    pushed = (eye[:, None] * matched[:, None])[:, : 3 * has_shifts]
    jacobian = np.concatenate([turned, pushed], axis=1).reshape(len(y), -1, 3 * y.shape[1])
    normal = jacobian @ jacobian.swapaxes(1, 2)
    normal += 1e-9 * np.eye(normal.shape[1])  # any pose is valid
    found = -np.linalg.solve(normal, jacobian @ off.reshape(len(y), -1, 1))[..., 0]
    return found[:, :3], found[:, 3:] if has_shifts else np.zeros((len(y), 3))


def _signed(half: np.ndarray) -> np.ndarray:
    """Return the (B, 8, 3) vertices of boxes around 0; only one if all boxes are flat."""
    return half[:, None] * (2.0 * BITS - 1.0) if half.any() else half[:, None]


def _largest_mean(points: np.ndarray, count: int) -> float:
    """Return an upper bound on the norm of the mean of `count` points.

    It is at most the mean of the largest norms. It is the maximum over all directions of the mean of the
    largest projections. A direction is at an angle of at most ``2 asin(sqrt(1/2) / cells)`` from the
    centre of its cell on a face of a cube.
    """
    if count == len(points):
        return float(np.linalg.norm(points.mean(axis=0)))
    best = -sum_of_smallest(-np.linalg.norm(points, axis=1), count) / count
    for cells in (8, 24):
        steps = (2.0 * np.arange(cells) + 1.0) / cells - 1.0
        face = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        half = np.concatenate([np.insert(face, axis, 1.0, axis=1) for axis in range(3)])
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        means = -sum_of_smallest(-(np.concatenate([half, -half]) @ points.T), count) / count
        farthest = max(0.0, float(means.max()))
        best = min(best, farthest / np.cos(2.0 * np.arcsin(np.sqrt(0.5) / cells)))
    return float(best)
