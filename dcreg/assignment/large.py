"""Local search on clouds too large for a dense matrix: nearest neighbours first, few matchings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcreg.assignment.alternation import follow_nearest
from dcreg.assignment.objective import objective
from dcreg.assignment.sparse import nearest_pairs
from dcreg.problem import Problem, exact_objective
from dcreg.problem.geometry import apply_pose
from dcreg.problem.trees import Tree, tree_of
from dcreg.search import Budget

# Points of both clouds from which one matching takes so long that there is only one, without a proof.
HUGE = 80_000
_FEW = 4000  # source points that follow their nearest neighbours
_MANY = 16_000  # ... where only one matching follows
_MAX_MATCHINGS = 5  # before the last one, which is to be proved
_PROVING_SHARE = 0.25  # of the time left, for the last matching
_QUICK_SHARE = 0.1  # ... for those of `quick_pairs`
# Alternating matching and fit converges slowly along the slopes of large clouds: a step is extended to
# so many times its length, and the plain step is taken if that fails.
_LONG_STEP = 4
# Seconds per point that a matching and a greedy one take on a common machine with two cores.
_MATCHING_S, _GREEDY_S = 4e-6, 2.5e-6
_OVER = np.ones(1, np.uint8)  # a stop flag
_FOLLOWING_SHARE = 0.3  # of the time left, at least, until the first matching
_MIN_GAIN = 1e-4  # relative decrease of the objective below which the local search ends


@dataclass(frozen=True)
class Descent:
    """Where a local search ended.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
    value : float
        Sum of squared residuals of the pairs.
    pairs : (k, 2) int array
    before : float
        An upper bound on the objective at the pose where the search began; at least `value`.
    n_assignments : int
    greedy : bool
        Whether the pairs were chosen greedily, because there was no time for more.
    """

    T_target_source: np.ndarray
    value: float
    pairs: np.ndarray
    before: float
    n_assignments: int
    greedy: bool


def residual(problem: Problem, T: np.ndarray, pairs: np.ndarray) -> float:
    """Return the sum of squared residuals of given pairs."""
    gaps = apply_pose(T, problem.source[pairs[:, 0]])
    gaps -= problem.target[pairs[:, 1]]
    return float(np.einsum("ij,ij->", gaps, gaps))


def is_huge(problem: Problem) -> bool:
    """Tell whether a matching of the clouds takes seconds."""
    return len(problem.source) + len(problem.target) > HUGE


def near_value(problem: Problem, T: np.ndarray, tree: Tree) -> float:
    """Return the squared distances of some source points to the target: a quick comparison of poses."""
    few, share = _thinned(problem, _FEW)
    return nearest_pairs(apply_pose(T, few), tree, share)[1]


def descend(
    problem: Problem,
    T_target_source: np.ndarray,
    budget: Budget,
    tree: Tree | None = None,
    *,
    prove: bool = True,
) -> Descent:
    """Follow nearest neighbours from a pose; then alternate one-to-one matching and fit.

    Nothing new begins when the budget is over. If the time left is too short for a matching, the pairs
    are chosen greedily.

    Parameters
    ----------
    problem : Problem
        Without candidates.
    T_target_source : (d+1, d+1) array
    budget : Budget
    tree : Tree, optional
        Of the target.
    prove : bool
        Whether the last matching should be optimal, except of huge clouds. It may take `_PROVING_SHARE`
        of the time left.
    """
    following, left = budget, budget.left()
    if left:  # the first matching needs the rest
        share = max(_FOLLOWING_SHARE, 1.0 - greedy_seconds(problem) / left)
        following = budget.sub_budget(share)
    T = _near_fit(problem, T_target_source, following, tree or tree_of(problem.target))
    stop = budget.hard_stop if has_time_to_match(problem, budget) else _OVER
    value, pairs = _matched(problem, T, stop)
    greedy, spent = bool(stop[0]), 1
    if not greedy:
        T, value, pairs, spent = _alternate(problem, T, value, pairs, budget)
    if not budget.is_over:  # the best pose of the pairs is free
        T = _fit(problem, pairs)
        value = residual(problem, T, pairs)
    before = max(value, residual(problem, T_target_source, pairs))
    is_exact = value <= exact_objective(problem.source, problem.target, problem.n_inliers)
    is_done = greedy or is_exact or budget.is_over or is_huge(problem)
    if prove and not is_done:
        proving = budget.isolated_sub_budget(_PROVING_SHARE)
        proved, best = _matched(problem, T, proving.stop, prove=True)
        spent += 1
        if proved < value:
            value, pairs = proved, best
    return Descent(T, value, pairs, before, spent, greedy)


def quick_pairs(problem: Problem, T: np.ndarray, budget: Budget) -> tuple[float, np.ndarray] | None:
    """Return the sum of squared residuals of rough pairs, and the pairs; None if time is over."""
    if budget.is_over or not has_time_to_match(problem, budget):
        return None
    return _matched(problem, T, budget.isolated_sub_budget(_QUICK_SHARE).stop)


def has_time_to_match(problem: Problem, budget: Budget) -> bool:
    """Tell whether the time left is enough for one quick matching."""
    left = budget.left()
    return left is None or left >= _seconds(problem, _MATCHING_S)


def greedy_seconds(problem: Problem) -> float:
    """Return about how long a greedy matching takes."""
    return _seconds(problem, _GREEDY_S)


def _seconds(problem: Problem, per_point: float) -> float:
    return per_point * (len(problem.source) + len(problem.target))


def _alternate(
    problem: Problem, T: np.ndarray, value: float, pairs: np.ndarray, budget: Budget
) -> tuple[np.ndarray, float, np.ndarray, int]:
    """Return pose, value and pairs after some long steps, and the matchings made for it and before."""
    low, high = problem.scale_range
    # a long step could leave the range of scales or of poses
    length = _LONG_STEP if low == high and problem.pose_range is None else 1
    spent, most = 1, 1 if is_huge(problem) else _MAX_MATCHINGS
    while spent < most and not budget.is_over:
        fitted = _fit(problem, pairs)
        step = fitted @ np.linalg.inv(T)
        trial = np.linalg.matrix_power(step, length - 1) @ fitted
        trial_value, trial_pairs = _matched(problem, trial, budget.hard_stop)
        spent += 1
        has_gained = trial_value < value * (1.0 - _MIN_GAIN)
        if not has_gained and length == 1:
            break
        if has_gained:
            T, value, pairs = trial, trial_value, trial_pairs
        else:
            length = 1
    return T, value, pairs, spent


def _fit(problem: Problem, pairs: np.ndarray) -> np.ndarray:
    return problem.fit(problem.source[pairs[:, 0]], problem.target[pairs[:, 1]])


def _matched(
    problem: Problem, T: np.ndarray, stop: np.ndarray, prove: bool = False
) -> tuple[float, np.ndarray]:
    return objective(
        problem.source, problem.target, T, problem.n_inliers, prove=prove, stop=stop, at_once=0
    )


def _near_fit(problem: Problem, T: np.ndarray, budget: Budget, tree: Tree) -> np.ndarray:
    """Return the pose at which some source points stop following their nearest neighbours."""

    def fit(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return problem.fit(source[0], target[0])[None]

    for count in (_FEW, _MANY) if is_huge(problem) else (_FEW,):
        some, share = _thinned(problem, count)
        T = follow_nearest(some, tree, T[None], share, fit, budget)[0][0]
    return T


def _thinned(problem: Problem, count: int) -> tuple[np.ndarray, int]:
    """Return at most `count` source points, and how many of them have partners."""
    some = problem.source[:: -(-len(problem.source) // count)]
    return some, max(3, round(problem.n_inliers * len(some) / len(problem.source)))
