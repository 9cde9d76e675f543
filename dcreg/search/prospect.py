"""Estimate by random descents how many boxes a proof takes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dcreg.search.boxes import Bound, Boxes
from dcreg.search.budget import Budget, Interrupted

ASKED_AFTER_S = 0.25  # seconds of search before the estimate; most searches end earlier
WATCHED_AFTER_S = 2.0  # ... if only the listener needs the estimate, which costs time
MAX_TIME_RATIO = 3.0  # estimated divided by remaining time above which no proof is expected
N_DESCENTS = 128
ESTIMATE_SHARE = 0.2  # of the time left, for the estimate; a longer one means that no proof is near
_MAX_DEPTH = 80  # divisions; the boxes of a longer descent contain the minimiser


def _all(boxes: Boxes) -> Boxes:
    return boxes


def expected_boxes(
    bound: Bound,
    branching: Callable[[Boxes], Boxes],
    cutoff: float,
    roots: Boxes | None = None,
    within_region: Callable[[Boxes], Boxes] = _all,
    is_late: Callable[[], bool] = bool,
) -> float:
    """Estimate how many boxes have to be bounded until every open box reaches `cutoff`.

    A random descent divides a box and continues with one of its halves until the bound reaches the
    cutoff. Every box at depth d stands for 2^d boxes of each root, so the sum of these weights is an
    unbiased estimate of the size of the tree (Knuth, Mathematics of Computation 29, 1975). Descents
    seldom meet a large subtree that covers a small share of the volume, such as that around the
    minimiser. The mean of a few descents is therefore usually too low.

    Parameters
    ----------
    bound : Bound
    branching : callable
        From boxes to their children, two for each.
    cutoff : float
        The lower bound at which a box is pruned.
    roots : Boxes, optional
        Default: those of the bound.
    within_region : callable, optional
        Returns those of some boxes that have to be bounded at all.
    is_late : callable, optional
        Whether to end the estimate. Default: never.

    Returns
    -------
    float
        inf if the estimate was ended.
    """
    rng = np.random.default_rng(0)
    roots = Boxes.of(bound.roots) if roots is None else roots
    boxes = roots[rng.integers(len(roots), size=N_DESCENTS)]
    weight, total = float(len(roots)), 0.0
    for _ in range(_MAX_DEPTH):
        total += weight * len(boxes)
        found = bound.evaluate(boxes, cutoff)
        bounds = np.maximum(found.lower_bounds, boxes.bounds)
        still = bounds < cutoff
        if not still.any():
            break
        if is_late():
            return math.inf
        kept = Boxes(boxes.lower, boxes.upper, bounds, found.warm_start)[still]
        halves = branching(kept)
        boxes = within_region(halves[2 * np.arange(len(kept)) + rng.integers(2, size=len(kept))])
        if not len(boxes):
            break
        weight *= 2.0
    return total / N_DESCENTS


@dataclass(frozen=True)
class Prospect:
    """How many boxes a search is expected to bound until its proof.

    Attributes
    ----------
    n_nodes : float
    """

    n_nodes: float

    @classmethod
    def of(
        cls,
        bound: Bound,
        branching: Callable[[Boxes], Boxes],
        cutoff: float,
        roots: Boxes,
        within_region: Callable[[Boxes], Boxes],
        budget: Budget,
        spent_s: float,
    ) -> Prospect:
        """Estimate by random descents; without time for them, the estimate is 0 boxes.

        `bound` must not be that of the search, because data that it stores about boxes would change the
        search. If the search can end without a proof, and the descents take more than `ESTIMATE_SHARE`
        of the time left, the estimate is inf.
        """
        late_s = math.inf
        if budget.patience_s is not None:
            late_s = budget.elapsed() + ESTIMATE_SHARE * _left_s(spent_s, budget)

        def is_late() -> bool:
            return budget.elapsed() > late_s

        try:
            return cls(expected_boxes(bound, branching, cutoff, roots, within_region, is_late))
        except Interrupted:
            return cls(0.0)

    def is_poor(self, n_nodes: int, spent_s: float, budget: Budget, aside_s: float = 0.0) -> bool:
        """Tell whether the proof is expected to take more than `MAX_TIME_RATIO` times the time left.

        Parameters
        ----------
        n_nodes : int
            Boxes bounded so far.
        spent_s : float
            Seconds since the search began.
        budget : Budget
        aside_s : float
            Of these seconds, those of other work than bounding boxes. There is little of it later.
        """
        if budget.patience_s is None:
            return False
        needed_s = self._needed_s(n_nodes, spent_s - aside_s)
        return needed_s > MAX_TIME_RATIO * _left_s(spent_s, budget)

    def expected_s(
        self, n_nodes: int, spent_s: float, budget: Budget, aside_s: float = 0.0
    ) -> float | None:
        """Return the seconds until the proof; inf if they exceed the time left, None if unknown.

        If the search has bounded more boxes than estimated, the number of boxes left is unknown. The
        parameters are those of `is_poor`.
        """
        needed_s = self._needed_s(n_nodes, spent_s - aside_s)
        if needed_s <= 0.0:
            return None
        return needed_s if needed_s <= _left_s(spent_s, budget) else math.inf

    def _needed_s(self, n_nodes: int, spent_s: float) -> float:
        """Return the seconds for the boxes left, at the speed of the boxes bounded so far."""
        return (self.n_nodes - n_nodes) * spent_s / n_nodes


def _left_s(spent_s: float, budget: Budget) -> float:
    """Return the seconds left for a proof: those of the budget, or of its patience if fewer."""
    left, patience = budget.left(), budget.patience_s
    return min(
        math.inf if left is None else left, math.inf if patience is None else patience - spent_s
    )
