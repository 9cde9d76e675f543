"""Guaranteed outlier removal: drops correspondences that can be in no largest consensus set.

A consensus set holds the correspondences i with ``|R x_i + t - y_i| <= bound`` for one pose. Every
number called `reach` is at least the size of the largest consensus set through a correspondence;
what reaches less than a consensus set already found goes.

For two members k and i of one set, ``|R (x_i - x_k) - (y_i - y_k)| <= 2 bound``. So each k is tried
as a common origin, which leaves a rotation and twice the bound. How many others one rotation can
bring within it is bounded by intervals of angles, and where these do not remove k, found exactly by
branch and bound over rotations. Intervals and tolerances may be too wide, never too narrow, so
rounding gets a margin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from baselines._shared.cubes import OutOfTimeError
from baselines._shared.kernels.lengths import consistency_graph
from baselines._shared.kernels.samples import count_within
from baselines._shared.robust import refit, squared_residuals
from baselines._shared.rotation_search import most_correspondences
from baselines.gore.kernels import LEFT, MOST, directions, drop_by_arcs
from dcreg.search import Budget

# For rounding, of the tolerance and of lengths (both relative).
MARGIN = 1e-9
LENGTH_MARGIN = 1e-15

# By intervals, a correspondence is tried again when no more than this share of its partners is left.
WORTHWHILE = 0.95
_ARCS_PER_SLICE = 100_000  # between two looks at the clock: some 15 ms


# (k, others) -> bound on the others in a set with k, and a rotation worth trying
BoundOnOthers = Callable[[int, np.ndarray], tuple[int, np.ndarray]]


@dataclass
class Removal:
    """What is left, and the largest consensus set met on the way."""

    kept: np.ndarray  # indices, sorted
    reach: np.ndarray  # bounds on the consensus sets through each that are not below `consensus`
    pose: np.ndarray | None
    consensus: int  # of that pose
    finished: bool


def remove_outliers(
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    budget: Budget,
    rotation_search: bool = True,
    start: np.ndarray | None = None,
) -> Removal:
    """Drop correspondences as long as one can be dropped, or until the budget is over.

    Parameters
    ----------
    source, target : (n, 3) arrays
        Row i of one corresponds to row i of the other.
    bound : float
        Largest residual in a consensus set.
    budget : Budget
    rotation_search : bool
        Search all rotations about the correspondences that the intervals of angles leave.
    start : (4, 4) array, optional
        A known pose; the larger its consensus set, the sooner others are dropped.
    """
    state = _Removing(source, target, bound, budget)
    if start is not None:
        state.take(start)
    try:
        state.settle(state.arcs)
        # What the search removes or finds lets the far cheaper intervals remove more.
        while rotation_search and state.sweep(state.search):
            state.settle(state.arcs)
        finished = True
    except OutOfTimeError:
        finished = False
    return Removal(np.flatnonzero(state.alive), state.reach, state.best, state.most, finished)


class _Removing:
    """Who is left of one problem, and the best pose met."""

    def __init__(self, source: np.ndarray, target: np.ndarray, bound: float, budget: Budget):
        self.source, self.target, self.bound, self.budget = source, target, bound, budget
        n = len(source)
        extent = sum(np.linalg.norm(np.ptp(points, axis=0)) for points in (source, target))
        self.tolerance = float(2 * bound * (1 + MARGIN) + LENGTH_MARGIN * extent)
        rows_as_pairs = np.column_stack([np.arange(n), np.arange(n)])  # a point may be in several
        rows = consistency_graph(source, target, rows_as_pairs, self.tolerance, 1.0)
        bits = np.unpackbits(rows.view(np.uint8), axis=1, bitorder="little")
        self.graph = bits[:, :n].astype(bool)
        self.alive = np.ones(n, dtype=bool)
        self.reach = self.graph.sum(axis=1) + 1
        self.best: np.ndarray | None = None
        self.most = 0
        self.agreeing = np.zeros(n, dtype=bool)  # with the best pose: they reach that many
        self.bounded = np.zeros((n, 2), dtype=int)  # partners and `most` at the last intervals
        self.searched = np.full(n, -1)  # number of partners at the last search

    def settle(self, bound_on_others: BoundOnOthers) -> None:
        """Sweep until nothing changes."""
        while self.sweep(bound_on_others):
            pass

    def sweep(self, bound_on_others: BoundOnOthers) -> bool:
        """Try every correspondence once as the origin; whether any went or the best pose rose."""
        before = self.alive.sum(), self.most
        for k in np.argsort(-self.reach, kind="stable"):
            if not self.alive[k] or self.agreeing[k]:
                continue
            others = np.flatnonzero(self.graph[k] & self.alive)
            self.reach[k] = min(self.reach[k], len(others) + 1)
            if self.reach[k] >= self.most:
                count, rotation = bound_on_others(k, others)
                self.reach[k] = min(self.reach[k], count + 1)
                self._offer(k, rotation)
            self.alive[k] = self.reach[k] >= self.most
            if self.budget.is_over:
                raise OutOfTimeError
        return before != (self.alive.sum(), self.most)

    def arcs(self, k: int, others: np.ndarray) -> tuple[int, np.ndarray]:
        """Bound on the others in a set with k of more than the best one's size, by intervals."""
        known, most = self.bounded[k]
        if len(others) > WORTHWHILE * known and self.most == most:
            return len(others), np.eye(3)  # hardly anything changed: the bound stands
        self.bounded[k] = len(others), self.most
        x, y = self.source[others] - self.source[k], self.target[others] - self.target[k]
        linked = self.graph[np.ix_(others, others)]
        return _rotation_reach(x, y, self.tolerance, self.most - 1, self.budget, linked)

    def search(self, k: int, others: np.ndarray) -> tuple[int, np.ndarray]:
        """The same by branch and bound: exact, unless it is too small for k to stay."""
        if self.searched[k] == len(others):  # they only become fewer: the same as last time
            return len(others), np.eye(3)
        x, y = self.source[others] - self.source[k], self.target[others] - self.target[k]
        # With `most - 1` others k stays, so counts up to one less need not be told apart.
        found = most_correspondences(x, y, self.tolerance, self.most - 2, 0, self.budget)
        self.searched[k] = len(others)
        return found.upper_bound, found.rotation

    def _offer(self, k: int, rotation: np.ndarray) -> None:
        """Take the pose of that rotation about k, fitted to those it suits, if it is the best."""
        source, target, bound = self.source, self.target, self.bound
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, target[k] - rotation @ source[k]
        if count_within(source, target, pose, bound) > 0.5 * self.most:
            pose = refit(pose, source, target, bound)
        self.take(pose)

    def take(self, pose: np.ndarray) -> None:
        """Keep the pose if its consensus set is the largest one met."""
        source, target, bound = self.source, self.target, self.bound
        consensus = int(count_within(source, target, pose, bound))
        if consensus > self.most:
            self.best, self.most = pose, consensus
            self.agreeing = squared_residuals(pose, source, target) <= bound**2


def _rotation_reach(
    source: np.ndarray,
    target: np.ndarray,
    tolerance: float,
    wanted: int,
    budget: Budget,
    linked: np.ndarray | None = None,
) -> tuple[int, np.ndarray]:
    """Bound on ``|{i: |R x_i - y_i| <= tolerance}|`` over all rotations, and the best R met.

    Correspondences that reach fewer than `wanted` are dropped until none is; the bound holds for
    all sets of `wanted` and more whose members are all ``linked`` with each other (by default: any).
    """
    if linked is None:
        linked = np.ones((len(source), len(source)), dtype=bool)
    x, y, spread = directions(source, target, tolerance)
    alive = np.ones(len(x), dtype=bool)
    rotation = np.eye(3)
    state = np.array([0, len(x), 0, 0, 0])
    while not drop_by_arcs(x, y, spread, linked, wanted, alive, rotation, state, _ARCS_PER_SLICE):
        if budget.is_over:
            return len(x), rotation  # no bound, but a rotation worth trying
    return int(min(state[LEFT], state[MOST])), rotation
