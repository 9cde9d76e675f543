"""Estimate by random descents how many boxes a proof takes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dcreg.search.boxes import Bound, Boxes
from dcreg.search.budget import Budget, Interrupted

ESTIMATED_AFTER_S = 0.25  # seconds of search before the estimate; most searches end earlier
# ... if only the listener needs the estimate, which costs time
ESTIMATED_FOR_LISTENER_AFTER_S = 2.0
MAX_TIME_RATIO = 1.5  # estimated divided by remaining time above which no proof is expected
# ... above which an unfinished estimate suffices: descents only add to it
CERTAIN_TIME_RATIO = 4.0 * MAX_TIME_RATIO
FEW_DESCENTS, N_DESCENTS = 16, 128  # of the first part of an estimate, and of both parts
# Share of the time left that the first part may take; after more, there is no second one.
ESTIMATE_SHARE = 0.1
# Time after the end of the patience in which a proof is awaited if it is expected: as a share of the
# patience, and at most.
GRACE_SHARE, MAX_GRACE_S = 0.4, 2.0
_MAX_DEPTH = 80  # divisions; the boxes of a longer descent contain the minimiser


def _all(boxes: Boxes) -> Boxes:
    return boxes


def expected_boxes(
    bound: Bound,
    branching: Callable[[Boxes], Boxes],
    cutoff: float,
    roots: Boxes | None = None,
    within_region: Callable[[Boxes], Boxes] = _all,
    is_late: Callable[[], bool] | None = None,
    is_enough: Callable[[float, int], bool] | None = None,
) -> tuple[float, int]:
    """Estimate how many boxes have to be bounded until every open box reaches `cutoff`.

    A random descent divides a box and continues with one of its halves until the bound reaches the
    cutoff. Every box at depth d stands for 2^d boxes of each root, so the sum of these weights is an
    unbiased estimate of the size of the tree (Knuth, Mathematics of Computation 29, 1975). Descents
    seldom meet a large subtree that covers a small share of the volume, such as that around the
    minimiser, so the mean of a few descents from the roots of a search is usually too low. From hundreds
    of open boxes it is accurate to about a third.

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
        Whether the first `FEW_DESCENTS` took so long that they have to suffice.
    is_enough : callable, optional
        From the mean so far and the number of boxes bounded: whether the descents may end early, because
        the proof takes too long in any case.

    Returns
    -------
    n_nodes : float
    n_tried : int
        Boxes bounded for the estimate.
    """
    rng = np.random.default_rng(0)
    roots = Boxes.of(bound.roots) if roots is None else roots
    # in turn, so that descents are spread evenly over few roots
    begun = np.resize(rng.permutation(len(roots)), N_DESCENTS)

    def descend(descents: slice) -> tuple[float, int]:
        """Return the sum of the weights of the boxes that some descents meet, and their number."""
        boxes, weight = roots[begun[descents]], float(len(roots))
        total, n_tried, depth = 0.0, 0, 0
        while len(boxes) and depth < _MAX_DEPTH:
            total, n_tried, depth = total + weight * len(boxes), n_tried + len(boxes), depth + 1
            found = bound.evaluate(boxes, cutoff)
            if is_enough is not None and is_enough(total / len(begun[descents]), n_tried):
                break
            bounds = np.maximum(found.lower_bounds, boxes.bounds)
            kept = Boxes(boxes.lower, boxes.upper, bounds, found.warm_start)[bounds < cutoff]
            one_of_two = 2 * np.arange(len(kept)) + rng.integers(2, size=len(kept))
            boxes = within_region(branching(kept)[one_of_two]) if len(kept) else kept
            weight *= 2.0
        return total, n_tried

    total, n_tried = descend(slice(FEW_DESCENTS))
    mean = total / FEW_DESCENTS
    if (is_late is not None and is_late()) or (is_enough is not None and is_enough(mean, n_tried)):
        return mean, n_tried
    more, n_more = descend(slice(FEW_DESCENTS, None))
    return (total + more) / N_DESCENTS, n_tried + n_more


@dataclass(frozen=True)
class Prospect:
    """How many boxes a search is expected to bound until its proof, and how this was estimated.

    Attributes
    ----------
    n_nodes : float
    n_tried : int
        Boxes bounded for the estimate.
    tried_s : float
        The seconds that this took.
    """

    n_nodes: float
    n_tried: int = 0
    tried_s: float = 0.0

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
        box_s: float = 0.0,
    ) -> Prospect:
        """Estimate by random descents; 0 boxes if the solve is stopped meanwhile.

        `bound` must not be that of the search, because data that it stores about boxes would change the
        search. `spent_s` are the seconds of the patience that are used, `box_s` those per box so far; if
        they are unknown, the estimate does not end early.
        """
        began = budget.elapsed()
        # the clock must not change a counted search
        left_s = math.inf if budget.is_counted else _left_s(spent_s, budget)

        def is_late() -> bool:
            return budget.elapsed() - began > ESTIMATE_SHARE * left_s

        def is_enough(mean: float, n_tried: int) -> bool:
            # the smaller of both times: a new bound is slow at first
            fastest_s = min(box_s, (budget.elapsed() - began) / n_tried)
            return mean * fastest_s > CERTAIN_TIME_RATIO * left_s

        try:
            found = expected_boxes(
                bound, branching, cutoff, roots, within_region, is_late, is_enough
            )
        except Interrupted:
            return cls(0.0)
        return cls(*found, budget.elapsed() - began)

    def is_poor(
        self, n_nodes: int, spent_s: float, budget: Budget, not_bounding_s: float = 0.0
    ) -> bool:
        """Tell whether the proof is expected to take more than `MAX_TIME_RATIO` times the time left.

        Parameters
        ----------
        n_nodes : int
            Boxes bounded so far.
        spent_s : float
            Seconds of the patience that are used.
        budget : Budget
        not_bounding_s : float
            Of these seconds, those of local searches and estimates. Most of this work is done early, so
            it does not count for the time per box.
        """
        if budget.patience_s is None:
            return False
        needed_s = self._needed_s(n_nodes, spent_s - not_bounding_s)
        is_long = needed_s > MAX_TIME_RATIO * _left_s(spent_s, budget)
        return is_long and not self.is_near(n_nodes, spent_s, budget, not_bounding_s)

    def is_near(
        self, n_nodes: int, spent_s: float, budget: Budget, not_bounding_s: float = 0.0
    ) -> bool:
        """Tell whether the proof is expected within the patience, or a short time after it.

        The parameters are those of `is_poor`.
        """
        patience_s = 0.0 if budget.patience_s is None else budget.patience_s
        grace_s = min(GRACE_SHARE * patience_s, MAX_GRACE_S)
        left_s = _left_s(spent_s, budget.with_patience(patience_s + grace_s))
        return 0.0 < self._needed_s(n_nodes, spent_s - not_bounding_s) <= left_s

    def expected_s(
        self, n_nodes: int, spent_s: float, budget: Budget, not_bounding_s: float = 0.0
    ) -> float | None:
        """Return the seconds until the proof; inf if they exceed the time left, None if unknown.

        If the search has bounded more boxes than estimated, the number of boxes left is unknown. The
        parameters are those of `is_poor`.
        """
        needed_s = self._needed_s(n_nodes, spent_s - not_bounding_s)
        if needed_s <= 0.0:
            return None
        return needed_s if needed_s <= _left_s(spent_s, budget) else math.inf

    def _needed_s(self, n_nodes: int, bounding_s: float) -> float:
        """Return the seconds for the boxes left, at the mean speed of the search and of the estimate."""
        box_s = (bounding_s + self.tried_s) / (n_nodes + self.n_tried)
        return (self.n_nodes - n_nodes) * box_s


def _left_s(spent_s: float, budget: Budget) -> float:
    """Return the seconds left for a proof: those of the budget, or of its patience if fewer."""
    left, patience = budget.left(), budget.patience_s
    return min(
        math.inf if left is None else left, math.inf if patience is None else patience - spent_s
    )
