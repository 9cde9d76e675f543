"""The joint polish: the last, switchable, local step on the full objective."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching
from scipy.spatial import cKDTree

from dcreg.assignment.k_assignment import k_assignment, pairs_of
from dcreg.assignment.sparse import is_large, nearest_pairs, sparse_matching
from dcreg.jit import NEVER
from dcreg.problem.geometry import apply_pose, fit_pose
from dcreg.search import Budget

# So few pairs are matched to the end in a quarter of a second, whatever the clock says.
AT_ONCE_PAIRS = 1_200_000
_MAX_ROUNDS = 100
_MAX_LARGE_ROUNDS = 10
# Relative decrease of the objective below which a descent ends.
_MIN_GAIN, _MIN_GAIN_LARGE, _MIN_GAIN_NEAREST = 1e-12, 1e-4, 1e-3

M = TypeVar("M")  # a matching, in whatever form


def alternate(
    theta: np.ndarray,
    value: float,
    matching: M,
    fit: Callable[[np.ndarray, M], np.ndarray | None],
    evaluate: Callable[[np.ndarray], tuple[float, M]],
    min_gain: float,
    max_rounds: int = _MAX_ROUNDS,
) -> tuple[np.ndarray, float, M, int]:
    """Alternate the best pose for a matching and the best matching at a pose while the objective falls.

    Parameters
    ----------
    theta : array
        A pose, or its parameter.
    value : float
        The objective at `theta`; infinite if `theta` need not be admissible.
    matching
        The matching at `theta`.
    fit : callable
        From a pose and a matching to the best pose for the matching, or None to end the descent.
    evaluate : callable
        From a pose to the objective and the matching.
    min_gain : float
        Relative decrease of the objective below which the descent ends; less is rounding.
    max_rounds : int

    Returns
    -------
    theta, value, matching, n_evaluations
    """
    spent = 0
    while spent < max_rounds and (trial := fit(theta, matching)) is not None:
        trial_value, trial_matching = evaluate(trial)
        spent += 1
        if trial_value >= value * (1.0 - min_gain):
            break
        theta, value, matching = trial, trial_value, trial_matching
    return theta, value, matching, spent


def objective(
    source: np.ndarray,
    target: np.ndarray,
    T_target_source: np.ndarray,
    n_inliers: int,
    candidates: np.ndarray | None = None,
    *,
    prove: bool = True,
    stop: np.ndarray = NEVER,
    at_once: int = AT_ONCE_PAIRS,
) -> tuple[float, np.ndarray]:
    """Least sum of squared residuals of `n_inliers` one-to-one pairs at a pose.

    Clouds too large for a dense matrix are matched over nearest neighbours, which is exact where it can
    be proved and else an upper bound, see ``dcreg.assignment.sparse.sparse_matching``.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
    T_target_source : (d+1, d+1) array
    n_inliers : int
    candidates : (n, m) bool array, optional
        The feasible pairs.
    prove : bool
        For large clouds: False takes a quick upper bound instead.
    stop : (1,) uint8 array
        Set from another thread, it asks for an upper bound at once: near pairs, chosen greedily.
    at_once : int
        Clouds of so many pairs of points are matched to the end all the same.

    Returns
    -------
    value : float, in squared units of the target
    assignment : (n_inliers, 2) int array
    """
    moved = apply_pose(T_target_source, source)
    if len(source) * len(target) <= at_once:
        stop = NEVER
    if candidates is None and (stop[0] or is_large(len(source), len(target))):
        found = sparse_matching(moved, target, n_inliers, prove=prove, stop=stop)
        return found.value, found.pairs
    cost = ((moved[:, None] - target[None]) ** 2).sum(axis=-1)
    if candidates is not None:
        cost[~candidates] = 1.0 + n_inliers * cost.max()
    value, col_of = k_assignment(cost, n_inliers, stop)
    if not stop[0]:
        return value, pairs_of(col_of)
    if candidates is None:
        found = sparse_matching(moved, target, n_inliers, prove=False, stop=stop)
        return found.value, found.pairs
    pairs = pairs_of(maximum_bipartite_matching(csr_array(candidates), perm_type="column"))
    own = cost[pairs[:, 0], pairs[:, 1]]
    kept = np.sort(np.argsort(own, kind="stable")[:n_inliers])
    return float(own[kept].sum()), pairs[kept]


def is_greedy(n: int, m: int, stop: np.ndarray) -> bool:
    """Whether `objective` chooses pairs of n and m points greedily by now."""
    return bool(stop[0]) and n * m > AT_ONCE_PAIRS


def polish(
    source: np.ndarray,
    target: np.ndarray,
    T_target_source: np.ndarray,
    n_inliers: int,
    scale_range: tuple[float, float],
    candidates: np.ndarray | None = None,
    budget: Budget | None = None,
) -> tuple[np.ndarray, float, np.ndarray, int]:
    """Alternate matching and least-squares pose from `T_target_source` until neither changes.

    Parameters
    ----------
    source, target, T_target_source, n_inliers, candidates
        As in `objective`.
    scale_range : (low, high)
    budget : Budget, optional
        When it is over no further step begins.

    Returns
    -------
    T_target_source, objective, assignment, n_assignments
        Never worse than the pose given.
    """
    budget = budget or Budget()
    large = candidates is None and is_large(len(source), len(target))

    def evaluate(T: np.ndarray) -> tuple[float, np.ndarray]:
        return objective(
            source, target, T, n_inliers, candidates, prove=not large, stop=budget.hard_stop
        )

    def fit(T: np.ndarray, pairs: np.ndarray) -> np.ndarray | None:
        if budget.is_over:
            return None
        if large and T is T_target_source:  # nearest neighbours first, which take no matching
            return follow_nearest(source, cKDTree(target), T, n_inliers, scale_range, budget)[0]
        return fit_pose(source[pairs[:, 0]], target[pairs[:, 1]], scale_range)

    value, pairs = evaluate(T_target_source)
    min_gain, max_rounds = (
        (_MIN_GAIN_LARGE, _MAX_LARGE_ROUNDS) if large else (_MIN_GAIN, _MAX_ROUNDS)
    )
    T, value, pairs, spent = alternate(
        T_target_source, value, pairs, fit, evaluate, min_gain, max_rounds
    )
    spent += 1
    if large and not budget.is_over:
        proved_value, proved_pairs = objective(source, target, T, n_inliers, stop=budget.hard_stop)
        spent += 1
        if proved_value < value:
            value, pairs = proved_value, proved_pairs
    return T, value, pairs, spent


def follow_nearest(
    source: np.ndarray,
    tree: cKDTree,
    T: np.ndarray,
    k: int,
    scale_range: tuple[float, float],
    budget: Budget | None = None,
) -> tuple[np.ndarray, float]:
    """Alternate the k nearest neighbours and the least-squares pose while their distance falls.

    The pose it ends at, and the sum of squared distances of its pairs, which are not one-to-one. `tree`
    holds the target.
    """

    def evaluate(T: np.ndarray) -> tuple[float, np.ndarray]:
        pairs, value = nearest_pairs(apply_pose(T, source), tree, k)
        return value, pairs

    def fit(T: np.ndarray, pairs: np.ndarray) -> np.ndarray | None:
        if budget is not None and budget.is_over:
            return None
        return fit_pose(source[pairs[:, 0]], tree.data[pairs[:, 1]], scale_range)

    value, pairs = evaluate(T)
    T, value, _, _ = alternate(T, value, pairs, fit, evaluate, _MIN_GAIN_NEAREST, _MAX_ROUNDS - 1)
    return T, value
