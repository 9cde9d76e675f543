"""The proof of a certificate: its leaves are a partition, and the stated lower bound holds on each."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dcreg.certificate.format import INADMISSIBLE, Certificate, CertificateError, UnprovenError
from dcreg.certificate.objective import Objective

TANGENT_STEPS = 10  # attempts to find a better tangent point
REFUTE_EVERY = 3  # bisections between two attempts to refute a bound that is not proven
FEW_LEAVES = 48  # a part with at most so many is not cut: comparing all leaves is faster
# Coordinates are equal if they differ by less than this fraction of the start box, or of the clouds if
# those are smaller.
SAME = 1e-12

# Called with the boxes bounded and those known to be needed so far.
Progress = Callable[[int, int], None]


# --- the partition --------------------------------------------------------------------------------


def check_partition(
    start_lower: np.ndarray,
    start_upper: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    numbers: np.ndarray | None = None,
    same: float = SAME,
) -> None:
    """Check that the leaves are a partition of the start box: no gap, no overlap, nothing outside.

    The box is cut between leaves, and its parts again, until each part has few leaves. The leaves are a
    partition of their part if they are in it, are disjoint, and together have as many cells of the grid.
    If not, the part is cut further, to name a faulty leaf. This works for every partition made by
    bisection. If no plane divides a part, its leaves overlap; if a single leaf does not fill its part,
    there is a gap.

    Parameters
    ----------
    start_lower, start_upper : (d,) arrays
        Start box, in normalised units.
    lower, upper : (L, d) arrays
        Leaf boxes.
    numbers : (L,) int array, optional
        Their numbers in messages; by default, 0 to L - 1.
    same : float
        Tolerance of coordinates; with 0, the check is exact.

    Raises
    ------
    CertificateError
        Naming a leaf next to the gap or in the overlap.
    """
    numbers = np.arange(len(lower)) if numbers is None else numbers
    if not (lower <= upper).all():
        raise CertificateError(
            f"leaf {numbers[np.argmin((lower <= upper).all(axis=1))]} is not a box"
        )
    grid = _Grid.of(start_lower, start_upper, lower, upper, same)
    wide = np.flatnonzero(grid.first < grid.last)  # a flat axis cannot be divided
    parts = [(grid.first, grid.last, np.arange(len(lower)))]
    while parts:
        first, last, leaves = parts.pop()
        if len(leaves) <= FEW_LEAVES and _are_partition(grid, first, last, leaves, wide):
            continue
        if len(leaves) == 1:
            leaf = leaves[0]
            if (grid.low[leaf] != first).any() or (grid.high[leaf] != last).any():
                raise CertificateError(
                    f"leaves: a gap or a part outside of the start box next to leaf {numbers[leaf]}"
                )
            continue
        axis, cut, left, right = _cut(grid, leaves, wide, numbers)
        cut_last, cut_first = last.copy(), first.copy()
        cut_last[axis] = cut_first[axis] = cut
        parts += [(first, cut_last, left), (cut_first, last, right)]


class _Grid(NamedTuple):
    """Coordinates as ranks among the distinct values of their axis, so that rounding does not matter.

    Attributes
    ----------
    low, high : (L, d) int arrays
        Leaf boxes.
    first, last : (d,) int arrays
        Start box.
    values : list of d arrays
        The coordinate of each rank.
    """

    low: np.ndarray
    high: np.ndarray
    first: np.ndarray
    last: np.ndarray
    values: list[np.ndarray]

    @classmethod
    def of(
        cls,
        start_lower: np.ndarray,
        start_upper: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        same: float,
    ) -> _Grid:
        table = np.vstack([lower, upper, start_lower, start_upper])
        ranks, distinct = np.empty(table.shape, np.int64), []
        for axis, column in enumerate(table.T):
            values, places = np.unique(column, return_inverse=True)
            begin, end = column[-2:]
            tolerance = same * (min(end - begin, 1.0) or max(1.0, abs(begin)))
            rank = np.concatenate([[0], np.cumsum(np.diff(values) > tolerance)])
            ranks[:, axis] = rank[places]
            distinct.append(values[np.concatenate([[True], np.diff(rank) > 0])])
        (low, high), (first, last) = np.split(ranks[:-2], 2), ranks[-2:]
        return cls(low, high, first, last, distinct)


def _are_partition(
    grid: _Grid, first: np.ndarray, last: np.ndarray, leaves: np.ndarray, wide: np.ndarray
) -> bool:
    """Tell whether leaves are in a part, are disjoint, and together have as many cells."""
    low, high = grid.low[leaves], grid.high[leaves]
    if (low < first).any() or (high > last).any():
        return False
    meet = (low[:, None, wide] < high[None, :, wide]).all(axis=2)
    meet = meet & meet.T  # every two leaves that share a cell
    np.fill_diagonal(meet, False)
    if meet.any():
        return False
    # Python's integers, which do not overflow
    sizes = (high - low)[:, wide].tolist()
    return sum(map(math.prod, sizes)) == math.prod((last - first)[wide].tolist())


def _cut(
    grid: _Grid, leaves: np.ndarray, axes: np.ndarray, numbers: np.ndarray
) -> tuple[int, int, np.ndarray, np.ndarray]:
    """Return a plane that crosses none of `leaves`: its axis and rank, and the leaves on either side.

    Of all such planes it is the one nearest to the centre of its axis, where bisection would cut.
    """
    best: tuple | None = None
    for axis in axes:
        low, high, values = grid.low[:, axis], grid.high[:, axis], grid.values[axis]
        order = leaves[np.argsort(low[leaves], kind="stable")]
        reach = np.maximum.accumulate(high[order])
        free = np.flatnonzero(low[order[1:]] >= reach[:-1])
        if not free.size:
            continue
        begin, end = values[low[order[0]]], values[reach[-1]]
        off = np.abs(values[reach[free]] - 0.5 * (begin + end)) / (end - begin or 1.0)
        at = int(np.argmin(off))
        if best is None or off[at] < best[0]:
            split = free[at] + 1
            best = (off[at], axis, reach[free[at]], order[:split], order[split:])
        if best[0] == 0.0:
            break
    if best is None:
        one, other = numbers[leaves[:2]]
        raise CertificateError(f"leaves: {one} and {other} or others near them overlap")
    return best[1:]


# --- the lower bound ------------------------------------------------------------------------------


class Proof:
    """A proof of the lower bound of a certificate on all its leaves, by dividing them further.

    Parameters
    ----------
    objective : Objective
    slack : float
        Tolerance of a bound for rounding errors.
    max_boxes : int
        The proof fails after this number of boxes.
    progress : callable, optional
        Receives the boxes bounded and those known to be needed.
    """

    def __init__(
        self, objective: Objective, slack: float, max_boxes: int, progress: Progress | None = None
    ) -> None:
        self.objective = objective
        self.slack = slack
        self.max_boxes = max_boxes
        self.progress = progress
        self.n_boxes = 0  # bounded in all calls of `run`
        self._bounds = [objective.nearest_bound, objective.interval_bound, self.tangent_bound]
        if objective.is_sorted_order:  # there the tangent bound needs no assignments and suffices
            self._bounds.remove(objective.interval_bound)

    def run(self, c: Certificate, lower_bound: float) -> None:
        """Prove a lower bound on every leaf.

        A leaf may state a larger bound. The claim does not depend on it, so it is not proven. It is
        refuted if the objective at the centre of the leaf is smaller.

        Raises
        ------
        UnprovenError
            If `max_boxes` boxes do not suffice.
        CertificateError
            If a bound is false.
        """
        leaves = self._order(c)
        lower, upper = c.leaf_lower[leaves], c.leaf_upper[leaves]
        needed = lower_bound - self.slack
        # leaves whose stated bound exceeds the one to be proven
        doubtful = c.leaf_bounds[leaves] > lower_bound + self.slack
        n_boxes = depth = 0
        while len(leaves):
            if n_boxes + len(leaves) > self.max_boxes:
                raise UnprovenError(
                    f"leaf {leaves[0]}: the lower bound {lower_bound * c.unit**2:.9g} could not be "
                    f"confirmed within {self.max_boxes} boxes"
                )
            bounds = np.empty(len(leaves))
            size = self.objective.n_at_once
            for at in range(0, len(leaves), size):
                part = slice(at, at + size)
                outside = self.objective.outside(lower[part], upper[part])
                self._check_inadmissible(leaves[part][~outside], c)
                bounds[part] = self._bound(leaves[part], lower[part], upper[part], outside, needed)
                if depth % REFUTE_EVERY == 0:
                    is_suspect = ~(bounds[part] >= needed) | (doubtful[part] & ~outside)
                    suspect = at + np.flatnonzero(is_suspect)
                    self._refute(lower[suspect], upper[suspect], leaves[suspect], c)
                if self.progress is not None:
                    done = n_boxes + min(at + size, len(leaves))
                    unproven = 2 * int((~(bounds[: at + size] >= needed)).sum())
                    self.progress(done, n_boxes + len(leaves) + unproven)
            n_boxes += len(leaves)
            self.n_boxes += len(leaves)
            depth += 1
            left = np.flatnonzero(~(bounds >= needed))  # NaN proves nothing
            far = np.repeat(bounds[left] < self.objective.far * needed, 2)
            leaves, lower, upper = self._halves(leaves[left], lower[left], upper[left])
            if far.any():
                parts = self._halves(leaves[far], lower[far], upper[far])
                leaves, lower, upper = (
                    np.concatenate([each[~far], part])
                    for each, part in zip((leaves, lower, upper), parts, strict=True)
                )
            doubtful = np.zeros(len(leaves), dtype=bool)  # each leaf is checked once

    def _order(self, c: Certificate) -> np.ndarray:
        """Return the leaves in the order in which they are proven."""
        return np.arange(len(c.leaf_bounds))

    @staticmethod
    def _check_inadmissible(leaves: np.ndarray, c: Certificate) -> None:
        """Check that none of these leaves, which may contain admissible poses, is stated to be empty."""
        stuck = leaves[c.leaf_reasons[leaves] == INADMISSIBLE]
        if stuck.size:
            raise CertificateError(
                f"leaf {stuck[0]} is stated to contain no admissible parameter, but may contain one"
            )

    def _bound(
        self,
        leaves: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        outside: np.ndarray,
        needed: float,
    ) -> np.ndarray:
        """Return the lower bounds of boxes of leaves up to about `needed`, by cheap bounds first."""
        # a sum of squares is never negative
        bounds = np.where(outside | (needed <= 0.0), np.inf, 0.0)
        for bound in self._bounds:
            unproven = np.flatnonzero(bounds < needed)
            if unproven.size:
                found = bound(lower[unproven], upper[unproven], needed)
                bounds[unproven] = np.fmax(bounds[unproven], found)
        return bounds

    def _refute(
        self, lower: np.ndarray, upper: np.ndarray, leaves: np.ndarray, c: Certificate
    ) -> None:
        """Refuse the certificate if the objective at the centre or an end of a box is below its bound."""
        points = np.stack([0.5 * (lower + upper), lower, upper])
        admissible = np.array([self.objective.admissible(some) for some in points])
        boxes = np.flatnonzero(admissible.any(axis=0))
        thetas = points[admissible.argmax(axis=0)[boxes], boxes]
        self.objective.refute(thetas, (c.leaf_bounds - self.slack)[leaves[boxes]], leaves[boxes])

    def tangent_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """Return the maximum over theta0 of the minimum over vertices v of the linearised objective.

        The objective of one matching is a difference of convex functions. With its first part replaced
        by the tangent at theta0 it is concave, so that its minimum is at a vertex v. There it is below E
        by ``sum p_ij R_i(v - theta0)``, the `linearisation_gaps` of the objective.
        """
        objective = self.objective
        vertices = _vertices(lower, upper)
        profiles = objective.profiles(vertices.reshape(-1, vertices.shape[2]))
        shape = vertices.shape[:2]
        rows = np.array([profile.rows for profile in profiles]).reshape(*shape, -1)
        totals = np.array([profile.total for profile in profiles]).reshape(shape)
        exact = np.array([profile.is_exact for profile in profiles]).reshape(shape)
        curvature = objective.curvature(lower, upper, needed)
        best = np.full(len(lower), -np.inf)
        bases = vertices.mean(axis=1)
        left = np.arange(len(lower))  # boxes that can still be proven
        while left.size:
            best[left], terms, bases[left] = self._best_base(
                vertices[left], rows[left], totals[left], curvature[left], needed, bases[left]
            )
            # only vertices that limit the bound need their exact profile
            binding = np.where(exact[left], np.inf, terms).argmin(axis=1)
            is_limited = ~exact[left, binding] & (best[left] < needed)
            left, binding = left[is_limited], binding[is_limited]
            for box, at in zip(left, binding, strict=True):
                rows[box, at], totals[box, at], exact[box, at] = objective.solved_profile(
                    vertices[box, at]
                )
        return np.minimum(best, needed)

    def _best_base(
        self,
        vertices: np.ndarray,
        rows: np.ndarray,
        totals: np.ndarray,
        curvature: np.ndarray,
        needed: float,
        base: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the best bound found, its values at the vertices, and its theta0.

        From `base`, theta0 moves in decreasing steps towards the vertex with the smallest value.
        """
        best, best_base = np.full(len(vertices), -np.inf), base.copy()
        best_terms = np.empty(vertices.shape[:2])
        left = np.arange(len(vertices))  # boxes not yet proven
        for step in range(TANGENT_STEPS):
            gaps = self.objective.linearisation_gaps(
                vertices[left] - base[left, None], curvature[left]
            )
            terms = self.objective.tangent_terms(rows[left], totals[left], gaps)
            lowest = terms.argmin(axis=1)
            found = terms[np.arange(len(left)), lowest]
            better = found > best[left]
            improved = left[better]
            best[improved], best_terms[improved] = found[better], terms[better]
            best_base[improved] = base[improved]
            base[left] += (vertices[left, lowest] - base[left]) / (step + 2)
            left = left[best[left] < needed]
            if not left.size:
                break
        return best, best_terms, best_base

    def _halves(
        self, leaves: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bisect each box along the edge that moves the source most; its leaf goes with both parts."""
        axis = np.argmax((upper - lower) * self.objective.weights, axis=1)
        lower, upper = np.repeat(lower, 2, axis=0), np.repeat(upper, 2, axis=0)
        rows = np.arange(len(axis))
        centre = 0.5 * (lower[2 * rows, axis] + upper[2 * rows, axis])
        upper[2 * rows, axis] = centre
        lower[2 * rows + 1, axis] = centre
        return np.repeat(leaves, 2), lower, upper


def _vertices(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return (B, V, d) vertices, without duplicates along axes that are flat in all boxes."""
    wide = np.flatnonzero((upper > lower).any(axis=0))
    bits = (np.arange(2 ** len(wide))[:, None] >> np.arange(len(wide))) & 1
    out = np.repeat(lower[:, None, :], len(bits), axis=1)
    out[:, :, wide] = np.where(bits, upper[:, None, wide], lower[:, None, wide])
    return out
