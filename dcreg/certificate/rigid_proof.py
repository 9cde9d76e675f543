"""The proof of a certificate of rigid poses: by the duals of its leaves, and by values at vertices.

The duals come from the file. Any duals are valid; with poor ones the proof takes more boxes. Boxes that
have a vertex in common share the value at this vertex.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np

from dcreg.certificate.format import Certificate, require
from dcreg.certificate.proof import Proof
from dcreg.certificate.rigid import BITS, ENDS, RigidPoses

WIDE = 0.6  # tangent of half the angle from which displacements prove nothing
# Squared displacements in a box, as multiples of the bound needed: after the vertices, caps are tried
# above the first, and Cayley's form below the second.
CAPPED, LINEAR = 100.0, 16.0
# Boxes of a leaf that may fail until an auction improves its duals there, or until they are optimal.
PATIENCE, EXACT = 2, 4
CURVE_BITS = 6  # of each coordinate, for the order of the leaves


class RigidProof(Proof):
    """A proof of the lower bound of a certificate of rigid poses, with the duals of its leaves."""

    objective: RigidPoses
    _duals: np.ndarray  # (L, m)
    _failures: np.ndarray  # boxes of each leaf that were not proven

    def run(self, c: Certificate, lower_bound: float) -> None:
        self._duals = self._read_duals(c)
        self._failures = np.zeros(len(c.leaf_bounds), np.int64)
        super().run(c, lower_bound)

    def _order(self, c: Certificate) -> np.ndarray:
        """Return the leaves along a curve that fills space, so that vertices are shared early."""
        centres = 0.5 * (c.leaf_lower + c.leaf_upper)
        low, size = centres.min(axis=0), np.ptp(centres, axis=0)
        cells = ((centres - low) / np.where(size > 0.0, size, 1.0) * (2**CURVE_BITS - 1)).astype(
            int
        )
        code = np.zeros(len(cells), np.int64)
        for bit in reversed(range(CURVE_BITS)):
            for column in cells.T:
                code = 2 * code + (column >> bit & 1)
        return np.argsort(code, kind="stable")

    def _read_duals(self, c: Certificate) -> np.ndarray:
        """Return the duals in the file; zeros if there are none."""
        m, stored, units = len(self.objective.target), c.leaf_duals, c.dual_units
        if not len(stored):
            return np.zeros((len(c.leaf_bounds), m), np.float32)
        n_duals = stored.shape[1]
        require(n_duals == m, f"leaf_duals: of {n_duals} points, but the cloud has {m}")
        # larger ones prove nothing, and their rounding errors would exceed the tolerance
        largest = np.ldexp(stored.max(axis=1).astype(np.float64), units).max()
        is_small = largest <= self.objective.max_dual
        require(is_small, "leaf_duals: larger than any squared distance")
        return np.ldexp(stored.astype(np.float32), units[:, None])

    def _bound(
        self,
        leaves: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        outside: np.ndarray,
        needed: float,
    ) -> np.ndarray:
        if needed <= 0.0:  # a sum of squares is never negative
            return np.full(len(leaves), np.inf)
        objective = self.objective
        bounds = self._bound_by(self._duals[leaves], lower, upper, needed)
        failed = np.flatnonzero(~(bounds >= needed))
        np.add.at(self._failures, leaves[failed], 1)
        stubborn = failed[self._failures[leaves[failed]] >= PATIENCE]
        values, own = np.empty(len(stubborn)), self._duals[leaves[stubborn]]
        for row, at in enumerate(stubborn):
            leaf, centre = leaves[at], 0.5 * (lower[at] + upper[at])
            values[row], own[row] = objective.improved(
                centre, self._duals[leaf], exactly=bool(self._failures[leaf] >= EXACT)
            )
            self._duals[leaf] = own[row]
        own, again = own[values >= needed], stubborn[values >= needed]
        if again.size:
            bounds[again] = self._bound_by(own, lower[again], upper[again], needed)
        return bounds

    def _bound_by(
        self, duals: np.ndarray, lower: np.ndarray, upper: np.ndarray, needed: float
    ) -> np.ndarray:
        """Bound boxes by their duals (B, m)."""
        objective, bounds = self.objective, np.zeros(len(lower))
        boxes = objective.boxes(lower, upper)
        # an upper bound on the sum of the squared displacements, relative to the bound needed
        reach = 2.0 * np.arctan(boxes.tangent) * objective.radius + boxes.shift
        displaced, is_wide = objective.k * reach**2 / needed, boxes.tangent > WIDE

        def vertex_bound(chosen: np.ndarray) -> np.ndarray:
            return Vertices(objective, lower[chosen], upper[chosen], duals[chosen]).bound(needed)

        def in_parts(bound: Callable[..., np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
            return lambda chosen: np.concatenate([
                bound(boxes.some(chosen[part]), duals[chosen[part]], needed)
                for part in objective.parts(len(chosen))
            ])  # fmt: skip

        needs_caps = is_wide | objective.has_few_pairs  # the search has no other bound for these
        for bound, is_tried in (
            (in_parts(objective.cap_bound), needs_caps),
            (vertex_bound, ~is_wide),
            (in_parts(objective.cap_bound), (displaced > CAPPED) & ~needs_caps),
            (in_parts(objective.cayley_bound), displaced < LINEAR),
        ):
            left = np.flatnonzero(~(bounds >= needed) & is_tried)
            if left.size:
                bounds[left] = np.fmax(bounds[left], bound(left))
        return bounds


class Vertices:
    """The V vertices of each of B boxes, with the duals (B, m) of the boxes.

    The vertices of a box are the products of its 8 rotations and its S shifts, in this order.
    """

    def __init__(
        self, objective: RigidPoses, lower: np.ndarray, upper: np.ndarray, duals: np.ndarray
    ) -> None:
        self._objective, self._duals = objective, duals
        self._boxes = objective.boxes(lower, upper)
        ends = ENDS[np.argmin((upper - lower)[:, :4], axis=1)]
        self._rotations = np.where(ends, upper[:, None, :4], lower[:, None, :4])
        self._shifts = self._boxes.centre[:, None, 4:]
        if self._boxes.half.any():
            self._shifts = np.where(BITS == 1, upper[:, None, 4:], lower[:, None, 4:])
        one, other = _numbers(self._rotations), _numbers(self._shifts)
        # (B, V): equal vertices have equal numbers
        self._numbers = (one[:, :, None] * (other.max() + 1) + other[:, None]).reshape(
            len(lower), -1
        )

    def bound(self, needed: float) -> np.ndarray:
        """Return bounds on the optima in the boxes, up to `needed`, by their centres and vertices."""
        costs = self._costs()
        bounds = self._objective.loss(self._boxes).proven(costs.min(axis=1))
        joint = self._objective.joint_loss(self._boxes)
        goals = 2.0 * joint.needed(needed)[:, None] - costs
        proves = (costs >= joint.doubled.needed(needed)[:, None]) | (bounds >= needed)[:, None]
        hardest = costs == costs.min(axis=1, keepdims=True)
        tried = hardest & ~proves
        proves[tried] = self._values(tried, goals) >= goals[tried]
        is_left: np.ndarray = (proves | ~hardest).all(axis=1)
        tried = ~proves & is_left[:, None]
        proves[tried] = self._values(tried, goals) >= goals[tried]
        bounds[proves.all(axis=1)] = np.inf
        return bounds

    def _costs(self) -> np.ndarray:
        """Return lower bounds (B, V) on the costs of all pairs at the centre, less the displacements."""
        objective, k, duals = self._objective, self._objective.k, self._duals
        out = np.empty(self._numbers.shape)

        def fill(part: slice) -> None:
            boxes = self._boxes.some(part)
            rows = objective.costs_with(boxes.centre, duals[part]).min(axis=2)[:, None, None]
            rows = rows - objective.displacements(boxes)
            if k == rows.shape[-1]:
                found = rows.sum(axis=-1)
            else:
                # the k smallest numbers sum to at least k level - sum max(0, level - number)
                level = np.partition(rows.mean(axis=2), k - 1, axis=-1)[..., k - 1, None]
                depths = np.maximum(level[..., None] - rows, 0.0, out=rows)
                found = k * level - depths.sum(axis=-1)
            total = duals[part].sum(axis=1, dtype=np.float64)
            out[part] = found.reshape(len(rows), -1) - total[:, None]

        _in_threads(fill, list(objective.parts(len(out))))
        return out

    def _values(self, chosen: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return lower bounds on the objective at chosen vertices, each computed once.

        The duals are the means of those of all boxes with the vertex.
        """
        boxes, vertices = np.nonzero(chosen)
        numbers, first, inverse = np.unique(
            self._numbers[chosen], return_index=True, return_inverse=True
        )
        boxes, vertices = boxes[first], vertices[first]
        n_shifts = self._shifts.shape[1]
        poses = np.hstack(
            [self._rotations[boxes, vertices // n_shifts], self._shifts[boxes, vertices % n_shifts]]
        )
        order, ordered = self._order
        begin, end = np.searchsorted(ordered, numbers), np.searchsorted(ordered, numbers, "right")
        values, goal = np.empty(len(poses)), np.full(len(poses), -np.inf)
        np.maximum.at(goal, inverse.ravel(), goals[chosen])

        def fill(part: slice) -> None:
            counts = (end - begin)[part]
            starts = np.cumsum(counts) - counts
            places = np.repeat(begin[part] - starts, counts) + np.arange(counts.sum())
            owners = order[places] // self._numbers.shape[1]
            duals = np.add.reduceat(self._duals[owners], starts, axis=0) / counts[:, None]
            values[part] = self._objective.rough_values(poses[part], duals)
            low = np.flatnonzero(values[part] < goal[part])
            if low.size:
                places = part.start + low
                values[places], _ = self._objective.auctioned(
                    poses[places], duals[low], goal[places]
                )

        _in_threads(fill, list(self._objective.parts(len(poses))))
        return values[inverse.ravel()]

    @cached_property
    def _order(self) -> tuple[np.ndarray, np.ndarray]:
        """The places of all vertices in ascending order of their numbers, and the sorted numbers."""
        order = np.argsort(self._numbers, axis=None, kind="stable")
        return order, self._numbers.ravel()[order]


def _numbers(points: np.ndarray) -> np.ndarray:
    """Return numbers of (B, V, d) points: equal for equal points, and smaller than B V."""
    numbers = np.zeros(points.shape[:2], np.int64)
    for column in np.moveaxis(points, 2, 0):
        ranks = np.unique(column, return_inverse=True)[1].reshape(numbers.shape)
        numbers = numbers * (ranks.max() + 1) + ranks
        numbers = np.unique(numbers, return_inverse=True)[1].reshape(numbers.shape)
    return numbers


def _in_threads(work: Callable[[slice], None], parts: list[slice]) -> None:
    """Do the work of independent parts; NumPy releases the interpreter's lock."""
    if len(parts) == 1:
        return work(parts[0])
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(work, parts))
    return None
