"""Guaranteed outlier removal: drops correspondences that can be in no maximum consensus set.

A consensus set contains the correspondences i with ``|R x_i + t - y_i| <= bound`` for one pose.
`reach` is an upper bound on the size of the maximum consensus set through a correspondence. A
correspondence whose reach is below the size of a known consensus set is removed.

For two members k and i of one set, ``|R (x_i - x_k) - (y_i - y_k)| <= 2 bound``. Each k therefore
serves as a common origin, which leaves a rotation and twice the bound. Intervals of angles bound how
many others one rotation can move within it. If they do not remove k, branch and bound over rotations
finds the number exactly. Intervals and tolerances may be too wide but not too narrow, so rounding has
a margin.
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

# Margins for the rounding of the tolerance and of lengths (both relative).
MARGIN = 1e-9
LENGTH_MARGIN = 1e-15

# Intervals try a correspondence again once at most this share of its partners is left.
WORTHWHILE = 0.95
_ARCS_PER_SLICE = 100_000  # between two checks of the budget, about 15 ms


# (k, others) -> bound on the others in a set with k, and a promising rotation
BoundOnOthers = Callable[[int, np.ndarray], tuple[int, np.ndarray]]


@dataclass
class Removal:
    """The remaining correspondences, and the largest consensus set found."""

    kept: np.ndarray  # indices, sorted
    reach: np.ndarray  # bounds on the consensus sets through each, if not below `consensus`
    pose: np.ndarray | None
    consensus: int  # of that pose
    finished: bool


def remove_outliers(
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    budget: Budget,
    rotation_search: bool = True,
) -> Removal:
    """Drop correspondences until none can be dropped or the budget is over.

    Parameters
    ----------
    source, target : (n, 3) arrays
        Row i of one corresponds to row i of the other.
    bound : float
        Maximum residual in a consensus set.
    budget : Budget
    rotation_search : bool
        Search all rotations about the correspondences that the intervals of angles do not remove.
    """
    state = _Removing(source, target, bound, budget)
    try:
        state.settle(state.arcs)
        # Removals and better poses by the search let the cheaper intervals remove more.
        while rotation_search and state.sweep(state.search):
            state.settle(state.arcs)
        finished = True
    except OutOfTimeError:
        finished = False
    return Removal(np.flatnonzero(state.alive), state.reach, state.best, state.most, finished)


class _Removing:
    """The remaining correspondences of a problem, and the best pose found."""

    def __init__(self, source: np.ndarray, target: np.ndarray, bound: float, budget: Budget):
        self.source, self.target, self.bound, self.budget = source, target, bound, budget
        n = len(source)
        extent = sum(np.linalg.norm(np.ptp(points, axis=0)) for points in (source, target))
        self.tolerance = float(2 * bound * (1 + MARGIN) + LENGTH_MARGIN * extent)
        rows_as_pairs = np.column_stack(
            [np.arange(n), np.arange(n)]
        )  # a point may be in several pairs
        rows = consistency_graph(source, target, rows_as_pairs, self.tolerance, 1.0)
        bits = np.unpackbits(rows.view(np.uint8), axis=1, bitorder="little")
        self.graph = bits[:, :n].astype(bool)
        self.alive = np.ones(n, dtype=bool)
        self.reach = self.graph.sum(axis=1) + 1
        self.best: np.ndarray | None = None
        self.most = 0
        self.agreeing = np.zeros(
            n, dtype=bool
        )  # with the best pose: their reach is at least its size
        self.bounded = np.zeros((n, 2), dtype=int)  # partners and `most` at the last interval bound
        self.searched = np.full(n, -1)  # number of partners at the last search

    def settle(self, bound_on_others: BoundOnOthers) -> None:
        """Sweep until nothing changes."""
        while self.sweep(bound_on_others):
            pass

    def sweep(self, bound_on_others: BoundOnOthers) -> bool:
        """Use every correspondence once as the origin; return whether anything changed."""
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
        """Bound the others in a set with k larger than the best set, by intervals."""
        known, most = self.bounded[k]
        if len(others) > WORTHWHILE * known and self.most == most:
            return len(others), np.eye(3)  # too few changes to try again: keep the bound
        self.bounded[k] = len(others), self.most
        x, y = self.source[others] - self.source[k], self.target[others] - self.target[k]
        linked = self.graph[np.ix_(others, others)]
        return _rotation_reach(x, y, self.tolerance, self.most - 1, self.budget, linked)

    def search(self, k: int, others: np.ndarray) -> tuple[int, np.ndarray]:
        """Bound the same by branch and bound: exact, unless k is removed."""
        if self.searched[k] == len(others):  # partners only become fewer: these are unchanged
            return len(others), np.eye(3)
        x, y = self.source[others] - self.source[k], self.target[others] - self.target[k]
        # k stays with `most - 1` others, so smaller counts need not be distinguished.
        found = most_correspondences(x, y, self.tolerance, self.most - 2, 0, self.budget)
        self.searched[k] = len(others)
        return found.upper_bound, found.rotation

    def _offer(self, k: int, rotation: np.ndarray) -> None:
        """Fit the pose of a rotation about k to its inliers, and keep it if it is the best."""
        source, target, bound = self.source, self.target, self.bound
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, target[k] - rotation @ source[k]
        if count_within(source, target, pose, bound) > 0.5 * self.most:
            pose = refit(pose, source, target, bound)
        self.take(pose)

    def take(self, pose: np.ndarray) -> None:
        """Keep the pose if its consensus set is the largest so far."""
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
    """Bound ``|{i: |R x_i - y_i| <= tolerance}|`` over all rotations; return also the best R found.

    Correspondences with a reach below `wanted` are dropped until none is left. The bound holds for all
    sets of at least `wanted` members that are all ``linked`` with each other (by default: any).
    """
    if linked is None:
        linked = np.ones((len(source), len(source)), dtype=bool)
    x, y, spread = directions(source, target, tolerance)
    alive = np.ones(len(x), dtype=bool)
    rotation = np.eye(3)
    state = np.array([0, len(x), 0, 0, 0])
    while not drop_by_arcs(x, y, spread, linked, wanted, alive, rotation, state, _ARCS_PER_SLICE):
        if budget.is_over:
            return len(x), rotation  # no bound, but a promising rotation
    return int(min(state[LEFT], state[MOST])), rotation
