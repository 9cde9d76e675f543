"""Rotation stage for large clouds: local searches from sampled rotations, without branch and bound.

The rotations of a fixed grid are scored by the nearest neighbours of a sample of the points. The best
ones are refined on a larger sample, and the best of those on all points. Each step alternates nearest
neighbours and the best rotation about the origin. No bound refers to the sample. The lower bound is
that of all points in norm space, which holds for every rotation because ``|R a - y| >= | |a| - |y| |``.
The upper bound is a one-to-one matching of all points. The stage is optimal only if these two bounds
meet; otherwise it ends as ``converged``.
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.descent import alternate
from dcreg.assignment.sparse import nearest_pairs, sparse_matching
from dcreg.families.rotation3d.kernels.geometry import best_rotation, rotation_matrix
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.translation3d.kernels.line import match_on_line
from dcreg.problem.trees import Tree, tree_of
from dcreg.search import Budget, Event, Outcome, Tolerance
from dcreg.status import Status

_CELLS_PER_AXIS = 7  # of the quaternion cube: about 25 degrees
_SAMPLE = 100
_SCORED_TARGETS = 2000
_DESCENTS = 12
_DESCENT_SAMPLE = 500
_MAX_ROUNDS = 50
_MIN_GAIN = 1e-4


def search_sampled_rotation(
    source_shifted: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    *,
    tolerance: Tolerance,
    budget: Budget,
) -> Outcome:
    """Return a good rotation about the origin for clouds that are too large for a search.

    Parameters
    ----------
    source_shifted, target : (n, 3), (m, 3) arrays
        The translation is already applied to the source; the clouds are not centred.
    n_inliers : int
    tolerance : Tolerance
    budget : Budget
        Checked after each local search; at least one is always made.

    Returns
    -------
    Outcome
        Its theta is a quaternion. The status is ``optimal`` only if the bounds of the full problem prove
        it, otherwise ``converged`` or the limit that was hit.
    """
    began = budget.elapsed()
    few, some = spread_rows(source_shifted, _SAMPLE), spread_rows(source_shifted, _DESCENT_SAMPLE)
    tree = tree_of(target)
    sparse_tree = Tree(target[spread_rows(target, _SCORED_TARGETS)])
    share = n_inliers / len(source_shifted)
    grid = Rotation3D.grid(_CELLS_PER_AXIS)
    scores = np.full(len(grid), np.inf)
    for at, q in enumerate(grid):
        if budget.is_over:
            break
        rotated = source_shifted[few] @ rotation_matrix(q).T
        scores[at] = nearest_pairs(rotated, sparse_tree, _part(share, few.size))[1]
    sample = source_shifted[some]
    descents: list[tuple[float, np.ndarray]] = []
    for at in np.argsort(scores, kind="stable")[:_DESCENTS]:
        theta = _descend(sample, target, tree, _part(share, some.size), grid[at], budget)
        descents.append((_two_sided(source_shifted, sample, target, tree, share, theta), theta))
        if budget.is_over:
            break
    descents.sort(key=lambda descent: descent[0])
    theta = descents[0][1]
    if not budget.is_over:
        theta = _descend(source_shifted, target, tree, n_inliers, theta, budget)
    rotated = source_shifted @ rotation_matrix(theta).T
    matching = sparse_matching(rotated, target, n_inliers, prove=False, stop=budget.stop)
    lower, _ = match_on_line(
        np.linalg.norm(source_shifted, axis=1), np.linalg.norm(target, axis=1), n_inliers
    )
    value, spent, now = matching.value, matching.n_assignments, budget.elapsed()
    lower = min(float(lower), value)
    status = tolerance.status(lower, value)
    if status is None:
        status = budget.ended_by if budget.is_over else Status.CONVERGED
    budget.report(Event("end", "rotation", now, 0, spent, 0, lower, value, status.value))
    return Outcome(status, theta, lower, value, 0, spent, now - began)


def spread_rows(points: np.ndarray, count: int) -> np.ndarray:
    """Return up to `count` rows at even ranks of the distance from the origin, for any point order."""
    order = np.argsort((points**2).sum(axis=1), kind="stable")
    ranks = np.linspace(0, len(points) - 1, min(count, len(points))).round().astype(int)
    return order[ranks]


def _part(share: float, count: int) -> int:
    return max(1, round(share * count))


def _descend(
    points: np.ndarray,
    target: np.ndarray,
    tree: Tree,
    k: int,
    theta: np.ndarray,
    budget: Budget,
) -> np.ndarray:
    """Alternate the k nearest neighbours and the best rotation while their distance decreases."""

    def evaluate(theta: np.ndarray) -> tuple[float, np.ndarray]:
        pairs, value = nearest_pairs(points @ rotation_matrix(theta).T, tree, k)
        return value, pairs

    def fit(theta: np.ndarray, pairs: np.ndarray) -> np.ndarray | None:
        if budget.is_over:
            return None
        return best_rotation(points[pairs[:, 0]].T, target[pairs[:, 1]].T)

    value, pairs = evaluate(theta)
    return alternate(theta, value, pairs, fit, evaluate, _MIN_GAIN, _MAX_ROUNDS - 1)[0]


def _two_sided(
    source: np.ndarray,
    sample: np.ndarray,
    target: np.ndarray,
    tree: Tree,
    share: float,
    theta: np.ndarray,
) -> float:
    """Return the mean squared distance of the nearest pairs, the larger one of both directions.

    If the source lies on one part of the target only, it is near the target, but the target is not near
    it.
    """
    rotation = rotation_matrix(theta)
    back = target[spread_rows(target, _DESCENT_SAMPLE)]
    k_back = _part(share * len(source) / len(target), len(back))
    k = _part(share, len(sample))
    _, there = nearest_pairs(sample @ rotation.T, tree, k)
    _, here = nearest_pairs(back, Tree(source @ rotation.T), k_back)
    return max(there / k, here / k_back)
