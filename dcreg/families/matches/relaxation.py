"""A lower bound over feasible pairs: can any rigid pose match k of them with a small objective?

Let E_k(T) be the sum of squared residuals of the cheapest k one-to-one feasible pairs at a pose T. For a
distance D, the score of a pose is the maximum of sum (1 - r^2 / D^2) over one-to-one selections of any
number of feasible pairs, where r are their residuals. The cheapest k pairs are such a selection, and no
selection has a larger sum than the best one. Hence k - E_k(T) / D^2 is at most the score of T, and

    E_k(T)  >=  D^2 (k - score(T))    for every pose T and every distance D.

So if no pose has a score of k - V / D^2 or more, then no pose has E_k <= V. This is the problem of
`dcreg.register_matches` with the feasible pairs as matches. Its bound refers to boxes of rotations only
and costs time in proportion to the number of feasible pairs, not of point pairs. Residuals beyond D do
not count, so the right-hand side can be far below E_k: only a refutation decides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dcreg.families.matches.bound import MatchBound
from dcreg.families.matches.problem import MatchProblem
from dcreg.families.matches.start import promising_poses
from dcreg.search import Boxes, Budget, Evaluation, Outcome, Start, Tolerance
from dcreg.status import Status

# D^2 in units of the mean squared residual V / k. A score of k (1 - 1 / RATIO) is to be refuted: with a
# larger D more is required, but wrong pairs count more.
RATIO = 3.0
TIME_SHARE = 0.8  # of the time left, at most
PATIENCE_S = 60.0  # at most: the bound need not converge to the objective

# pose -> (parameter, objective, assignments spent)
LocalSearch = Callable[[np.ndarray], tuple[np.ndarray, float, int]]


class RelaxedBound(MatchBound):
    """Lower bounds on the objective over k feasible pairs, over boxes of rotations.

    Parameters
    ----------
    problem : MatchProblem
        Its inlier threshold is D.
    n_inliers : int
        k, at most the maximum cardinality.
    tolerance : Tolerance
        With a target V.
    """

    def __init__(self, problem: MatchProblem, n_inliers: int, tolerance: Tolerance) -> None:
        # from a cost of the matches to a bound on the objective: D^2 (k - score)
        self.shift = (n_inliers - problem.max_cardinality) * problem.inlier_threshold**2
        super().__init__(problem, tolerance.cutoff(np.inf) - self.shift, tolerance)

    def evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        """Bound B boxes; the values are those of the relaxation."""
        found = super().evaluate(boxes, None if cutoff is None else cutoff - self.shift)
        found.lower_bounds += self.shift
        found.values += self.shift
        return found

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Search locally from a pose."""
        theta, value, spent = super().refine(theta)
        return theta, value + self.shift, spent


def search_relaxation(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    candidates: np.ndarray,
    *,
    limit: float,
    local_search: LocalSearch,
    stage: str,
    budget: Budget,
) -> Outcome:
    """Decide whether a pose may have an objective of at most `limit`.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    n_inliers : int
    candidates : (n, m) bool array
    limit : float
    local_search : callable
        From a (4, 4) pose to a parameter and its objective.
    stage : str
    budget : Budget

    Returns
    -------
    Outcome
        With a parameter and its objective as upper bound. Status ``refuted`` if no pose reaches `limit`;
        ``converged`` if this one does, or if the relaxation cannot decide.
    """
    began = budget.elapsed()
    reach = float(np.sqrt(RATIO * limit / n_inliers))
    problem = MatchProblem(source, target, np.argwhere(candidates), reach)
    tolerance = Tolerance(target=limit)
    patience_s = PATIENCE_S if budget.patience_s is None else min(budget.patience_s, PATIENCE_S)
    searching = budget.sub_budget(TIME_SHARE).with_patience(patience_s)
    cost, pose = promising_poses(problem, searching.silent())[0]
    theta, value, spent = local_search(problem.pose(pose))
    if value <= limit:
        time_s = budget.elapsed() - began
        return Outcome(Status.CONVERGED, theta, 0.0, value, 0, spent, time_s)
    bound = RelaxedBound(problem, n_inliers, tolerance)
    found = bound.search(
        searching.with_incumbent(value), Start(pose.ravel(), cost + bound.shift), stage
    )
    if found.status is not Status.REFUTED:
        other = local_search(problem.pose(found.theta.reshape(3, 4)))
        theta, value, spent = min((theta, value, spent), other, key=lambda each: each[1])
    return replace(
        found, theta=theta, upper_bound=value, lower_bound=max(0.0, found.lower_bound),
        n_assignments=spent, time_s=budget.elapsed() - began,
    )  # fmt: skip
