"""How many boxes a proof would take, estimated by random descents."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from dcreg.search.boxes import Bound, Boxes
from dcreg.search.budget import Budget, Interrupted

_LOGGER = logging.getLogger("dcreg")

ASKED_AFTER_S = 0.25  # of a search: most end before
HOPELESS = 3.0  # estimated times, in times left, from which a proof is not expected
N_DESCENTS = 128
_MAX_DEPTH = 80  # divisions; a descent that goes on so long contains the minimiser


def expected_boxes(bound: Bound, branching: Callable[[Boxes], Boxes], cutoff: float) -> float:
    """Estimate how many boxes have to be bounded until every open box reaches `cutoff`.

    A random descent divides a box and goes on with one of its halves until the bound reaches the cutoff.
    Every box at depth d stands for 2^d boxes, so the sum of these weights is an unbiased estimate of the
    size of the tree (Knuth, Mathematics of Computation 29, 1975). Large subtrees of a small share of the
    volume, such as that around the minimiser, are seldom met: the mean of a few descents is usually too
    low.

    Parameters
    ----------
    bound : Bound
    branching : callable
        From boxes to their children, two for each.
    cutoff : float
        The lower bound at which a box is done.

    Returns
    -------
    float
    """
    rng = np.random.default_rng(0)
    roots = Boxes.of(bound.roots)
    boxes = roots[rng.integers(len(roots), size=N_DESCENTS)]
    weight, total = float(len(roots)), 0.0
    for _ in range(_MAX_DEPTH):
        total += weight * len(boxes)
        found = bound.evaluate(boxes, cutoff)
        bounds = np.maximum(found.lower_bounds, boxes.bounds)
        still = bounds < cutoff
        if not still.any():
            break
        kept = Boxes(boxes.lower, boxes.upper, bounds, found.warm_start)[still]
        halves = branching(kept)
        boxes = halves[2 * np.arange(len(kept)) + rng.integers(2, size=len(kept))]
        weight *= 2.0
    return total / N_DESCENTS


class Prospect:
    """Whether a search is expected to end with a proof.

    The number of boxes is estimated once, after `ASKED_AFTER_S`; the time for a box is that of the boxes
    so far. A search with a limit on boxes or assignments always goes on, because its end must not depend
    on the clock.

    Parameters
    ----------
    bound : Bound
    branching : callable
    budget : Budget
    patience_s : float, optional
        Seconds that the search may take for a proof; inf: those of the budget; None: it always goes on.

    Attributes
    ----------
    n_assignments : int
        Solved for the estimate; they are not part of the search.
    """

    n_assignments = 0

    def __init__(
        self,
        bound: Bound,
        branching: Callable[[Boxes], Boxes],
        budget: Budget,
        patience_s: float | None,
    ) -> None:
        is_counted = budget.nodes is not None or budget.assignments is not None
        self._patience_s = None if is_counted else patience_s
        self._bound, self._branching, self._budget = bound, branching, budget
        self._began = budget.elapsed()
        self._expected = 0.0  # boxes; 0: not estimated yet

    def is_poor(self, n_nodes: int, cutoff: float) -> bool:
        """Tell whether a search that has bounded `n_nodes` boxes is not expected to end in time."""
        spent = self._budget.elapsed() - self._began
        if self._patience_s is None or spent < ASKED_AFTER_S:
            return False
        limit = self._budget.left()
        left = min(self._patience_s - spent, np.inf if limit is None else limit)
        if self._expected == 0.0:
            try:
                self._expected = self._estimate(cutoff)
            except Interrupted:
                return False
            needed_s = self._expected * spent / n_nodes
            if needed_s <= HOPELESS * left:
                _LOGGER.info("proof expected after about %.2g s of search", needed_s)
        return (self._expected - n_nodes) * spent / n_nodes > HOPELESS * left

    def _estimate(self, cutoff: float) -> float:
        before = self._bound.n_assignments
        expected = expected_boxes(self._bound, self._branching, cutoff)
        self.n_assignments = self._bound.n_assignments - before
        return expected
