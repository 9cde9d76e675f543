"""The objective at a pose: the exact k-cardinality assignment, or a quick upper bound on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dcreg.assignment import sparse
from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.jit import NEVER
from dcreg.problem import Problem, largest_matching
from dcreg.problem.geometry import apply_pose
from dcreg.problem.weights import AT_ONCE_PAIRS

_MANY_PAIRS = 250_000  # beyond which a matching begins with nearest neighbours


def k_assignment(cost: np.ndarray, k: int, stop: np.ndarray = NEVER) -> tuple[float, np.ndarray]:
    """Return the cheapest one-to-one choice of exactly k pairs in a dense cost matrix.

    Minimises ``sum_ij p_ij cost_ij`` over binary P with row and column sums at most one and total k.
    The LP relaxation is integral, so this is also its optimum.

    Parameters
    ----------
    cost : (n, m) array of finite numbers, of any sign
    k : int, 1 <= k <= min(n, m)
    stop : (1,) uint8 array
        Set from another thread to end the call early; the output is then incomplete.

    Returns
    -------
    value : float
    col_of : (n,) int array
        Column matched to each row, -1 where a row is unmatched.

    Raises
    ------
    ValueError
        If `cost` is not a finite matrix or k is out of range.
    """
    cost = np.ascontiguousarray(cost, dtype=np.float64)
    if cost.ndim != 2 or not np.isfinite(cost).all():
        raise ValueError("cost must be a matrix of finite numbers")
    if not 1 <= k <= min(cost.shape):
        raise ValueError(f"k={k} pairs asked of a {cost.shape[0]} x {cost.shape[1]} cost matrix")
    value, col_of, _ = cheapest_pairs(cost, int(k), stop)
    return float(value), col_of


def pairs_of(col_of: np.ndarray) -> np.ndarray:
    """Return the (k, 2) matched pairs (row, column) of a `col_of` vector."""
    rows = np.flatnonzero(col_of >= 0)
    return np.stack([rows, col_of[rows]], axis=1).astype(np.int64)


def is_large(n: int, m: int) -> bool:
    """Tell whether the pairs of n and m points are too many for a dense matrix."""
    return n * m > sparse.DENSE_PAIRS


def objective(
    source: np.ndarray,
    target: np.ndarray,
    T_target_source: np.ndarray,
    n_inliers: int,
    candidates: np.ndarray | None = None,
    **effort: Any,
) -> tuple[float, np.ndarray]:
    """Return the minimum sum of squared residuals of `n_inliers` one-to-one pairs at a pose.

    Clouds too large for a dense matrix are matched over nearest neighbours. The result is then exact if
    this can be proved, otherwise an upper bound; see ``dcreg.assignment.sparse.sparse_matching``.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
    T_target_source : (d+1, d+1) array
    n_inliers : int
    candidates : (n, m) bool array, optional
        The feasible pairs.
    **effort
        ``prove``, ``stop`` and ``at_once`` of `match_at`, for large clouds.

    Returns
    -------
    value : float, in squared units of the target
    assignment : (n_inliers, 2) int array
    """
    return match_at(source, target, T_target_source, n_inliers, candidates, **effort)[:2]


def weighted_objective(problem: Problem, T_target_source: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the minimum cost of one-to-one pairs of weighted points at a pose, and the pairs."""
    assert problem.weights is not None
    moved = apply_pose(T_target_source, problem.source)
    squares = ((moved[:, None] - problem.target[None]) ** 2).sum(axis=-1)
    return _cheapest(problem, problem.weights.costs(squares))


def constant_cost(problem: Problem) -> float:
    """Return the minimum over all matchings of what weights and attributes cost at every pose."""
    return 0.0 if problem.weights is None else _cheapest(problem, problem.weights.extra.copy())[0]


def _cheapest(problem: Problem, cost: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the minimum cost of one-to-one feasible pairs, and the pairs; overwrites `cost`."""
    if problem.candidates is not None:
        cost[~problem.candidates] = 1.0 + problem.n_inliers * cost.max()
    value, col_of = k_assignment(cost, problem.n_inliers)
    return value, pairs_of(col_of)


def match_at(
    source: np.ndarray,
    target: np.ndarray,
    T_target_source: np.ndarray,
    n_inliers: int,
    candidates: np.ndarray | None = None,
    *,
    prove: bool = True,
    stop: np.ndarray = NEVER,
    at_once: int = AT_ONCE_PAIRS,
) -> tuple[float, np.ndarray, bool]:
    """Return value and pairs of `objective`, and whether the pairs were chosen greedily.

    If there are many pairs of points, each point's nearest neighbours are tried first. At good poses
    they prove the optimum, in a tenth of the time of a dense matrix or less.

    Parameters
    ----------
    source, target, T_target_source, n_inliers, candidates
        As in `objective`.
    prove : bool
        For large clouds: False returns a quick upper bound instead.
    stop : (1,) uint8 array
        Set from another thread to get an upper bound at once: near pairs, chosen greedily.
    at_once : int
        Maximum number of pairs of points that are matched exactly even if `stop` is set.
    """
    moved, n_pairs = apply_pose(T_target_source, source), len(source) * len(target)
    is_dense = not is_large(len(source), len(target))
    if n_pairs <= at_once:
        stop = NEVER
    if candidates is None and (stop[0] or n_pairs > _MANY_PAIRS):
        found = sparse.sparse_matching(
            moved, target, n_inliers, prove=prove or is_dense,
            most=0 if is_dense else sparse.DENSE_PAIRS, stop=stop,
        )  # fmt: skip
        if stop[0] or found.exact or not is_dense:
            return found.value, found.pairs, bool(stop[0])
    cost = ((moved[:, None] - target[None]) ** 2).sum(axis=-1)
    if candidates is not None:
        cost[~candidates] = 1.0 + n_inliers * cost.max()
    value, col_of = k_assignment(cost, n_inliers, stop)
    if not stop[0]:
        return value, pairs_of(col_of), False
    if candidates is None:
        found = sparse.sparse_matching(moved, target, n_inliers, prove=False, stop=stop)
        return found.value, found.pairs, True
    pairs = pairs_of(largest_matching(candidates))
    own = cost[pairs[:, 0], pairs[:, 1]]
    kept = np.sort(np.argsort(own, kind="stable")[:n_inliers])
    return float(own[kept].sum()), pairs[kept], True


@dataclass(frozen=True)
class Matched:
    """One-to-one pairs, and the pose at which they were matched.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
    pairs : (K, 2) int array
    greedy : bool
        Whether the pairs were chosen greedily, nearest first.
    """

    T_target_source: np.ndarray
    pairs: np.ndarray
    greedy: bool = False

    def cheapest(
        self, source: np.ndarray, target: np.ndarray, T: np.ndarray, k: int
    ) -> tuple[float, np.ndarray]:
        """Return the sum of squared residuals of the k cheapest of the pairs at `T`, and these pairs."""
        moved = apply_pose(T, source[self.pairs[:, 0]])
        moved -= target[self.pairs[:, 1]]
        costs = np.einsum("ij,ij->i", moved, moved)
        kept = np.sort(np.argpartition(costs, k - 1)[:k])
        return float(costs[kept].sum()), self.pairs[kept]


def quick_objective(
    problem: Problem,
    T_target_source: np.ndarray,
    known: Matched | None = None,
    *,
    prove: bool = True,
    stop: np.ndarray = NEVER,
) -> tuple[float, np.ndarray, bool]:
    """Match at a pose; once `stop` is set, take the better of the new pairs and of known ones.

    Parameters
    ----------
    problem : Problem
    T_target_source : (d+1, d+1) array
    known : Matched, optional
        Feasible pairs, at least `n_inliers`.
    prove, stop
        As in `match_at`.

    Returns
    -------
    value, assignment, greedy
        As in `match_at`. The value is that of these pairs, an upper bound on the minimum.
    """

    if problem.weights is not None:
        return *weighted_objective(problem, T_target_source), False
    source, target, k = problem.source, problem.target, problem.n_inliers

    def own() -> tuple[float, np.ndarray, bool]:
        return match_at(
            source, target, T_target_source, k, problem.candidates, prove=prove, stop=stop
        )

    if known is None or not stop[0]:
        return own()
    value, pairs = known.cheapest(source, target, T_target_source, k)
    # own pairs of small clouds are exact: known ones can be as good, not better
    given = value, pairs, len(source) * len(target) > AT_ONCE_PAIRS
    if known.greedy and np.array_equal(known.T_target_source, T_target_source):
        return given  # greedy pairs for fewer points are the first of these
    return min(own(), given, key=lambda matched: matched[0])
