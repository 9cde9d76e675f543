"""The joint polish: the last, switchable, local step on the full objective."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching
from scipy.spatial import cKDTree

from dcreg.assignment.k_assignment import k_assignment, pairs_of
from dcreg.assignment.sparse import is_large, nearest_pairs, sparse_matching
from dcreg.jit import NEVER
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

# So few pairs are matched to the end in a quarter of a second, whatever the clock says.
AT_ONCE_PAIRS = 1_200_000
_MAX_ROUNDS = 100
_MAX_LARGE_ROUNDS = 10
# Share of the objective by which a step has to lower it.
_LEAST_GAIN, _LEAST_GAIN_LARGE = 1e-12, 1e-4


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
    d = source.shape[1]
    moved = source @ T_target_source[:d, :d].T + T_target_source[:d, d]
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

    def quick(T: np.ndarray) -> tuple[float, np.ndarray]:
        return objective(
            source, target, T, n_inliers, candidates, prove=not large, stop=budget.hard_stop
        )

    T = T_target_source
    value, pairs = quick(T)
    spent = 1
    trial = None
    for _ in range(_MAX_LARGE_ROUNDS if large else _MAX_ROUNDS):
        if budget.is_over:
            return T, value, pairs, spent
        if trial is None and large:  # first by nearest neighbours, which takes no matching
            trial, _ = follow_nearest(source, cKDTree(target), T, n_inliers, scale_range, budget)
        else:
            trial = fit_pose(source[pairs[:, 0]], target[pairs[:, 1]], scale_range)
        trial_value, trial_pairs = quick(trial)
        spent += 1
        if trial_value >= value * (1.0 - (_LEAST_GAIN_LARGE if large else _LEAST_GAIN)):
            break
        T, value, pairs = trial, trial_value, trial_pairs
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
    d = source.shape[1]
    best, least = T, np.inf
    for _ in range(_MAX_ROUNDS):
        pairs, value = nearest_pairs(source @ T[:d, :d].T + T[:d, d], tree, k)
        if value >= least * (1.0 - 1e-3) or (budget is not None and budget.is_over):
            break
        best, least = T, value
        T = fit_pose(source[pairs[:, 0]], tree.data[pairs[:, 1]], scale_range)
    return best, least
