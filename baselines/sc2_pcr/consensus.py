"""Consensus sets by second-order spatial compatibility."""

from __future__ import annotations

import numpy as np

from baselines._shared.consistency import length_differences
from baselines._shared.kernels.samples import count_within
from baselines._shared.robust import squared_residuals
from baselines.sc2_pcr.kernels import common_neighbours, submatrix
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

POWER_ITERATIONS = 10
REFINEMENTS = 20


def leading_eigenvector(matrix: np.ndarray) -> np.ndarray:
    """Return the unit leading eigenvector by power iteration; zeros for a zero matrix."""
    u = np.full(len(matrix), 1 / np.sqrt(len(matrix)))
    for _ in range(POWER_ITERATIONS):
        u = matrix @ u
        norm = np.linalg.norm(u)
        if norm == 0:
            return u
        u = u / norm
    return u


def choose_seeds(source: np.ndarray, target: np.ndarray, tolerance: float, most: int) -> np.ndarray:
    """Return the correspondences whose confidence is maximal among sources within `tolerance`.

    The confidence is the leading eigenvector of the compatibility in lengths within `tolerance`.
    """
    differences = length_differences(source, target)
    confidence = leading_eigenvector(np.maximum(0.0, 1 - (differences / tolerance) ** 2))
    order = np.argsort(-confidence, kind="stable")
    free = np.ones(len(source), dtype=bool)
    seeds: list[int] = []
    for i in order:
        if len(seeds) == most:
            break
        if free[i]:
            seeds.append(int(i))
            free &= ((source - source[i]) ** 2).sum(axis=1) > tolerance**2
    return np.array(seeds)


def best_pose(
    source: np.ndarray,
    target: np.ndarray,
    rows: np.ndarray,
    seeds: np.ndarray,
    sizes: tuple[int, int],
    bound: float,
    budget: Budget,
) -> tuple[np.ndarray | None, bool]:
    """Return the pose with the most residuals within `bound`, and whether all seeds were tried."""
    best, most = None, 0
    for seed in seeds:
        pose = seed_pose(source, target, rows, seed, sizes)
        if pose is not None:
            count = int(count_within(source, target, pose, bound))
            if count > most:
                best, most = pose, count
        if budget.is_over:
            return best, False
    return best, True


def seed_pose(
    source: np.ndarray, target: np.ndarray, rows: np.ndarray, seed: int, sizes: tuple[int, int]
) -> np.ndarray | None:
    """Return the weighted pose of the consensus set of a seed; None if the set is too small."""
    members, weights = _consensus(rows, seed, *sizes)
    if len(members) < source.shape[1] or weights.sum() <= 0:
        return None
    return fit_pose(source[members], target[members], (1.0, 1.0), weights)


def refine(pose: np.ndarray, source: np.ndarray, target: np.ndarray, bound: float) -> np.ndarray:
    """Refit the inliers, with larger weights for small residuals, while their number changes."""
    count = 0
    for _ in range(REFINEMENTS):
        r2 = squared_residuals(pose, source, target)
        inliers = r2 <= bound**2
        if inliers.sum() == count or inliers.sum() < source.shape[1]:
            break
        count = int(inliers.sum())
        pose = fit_pose(source, target, (1.0, 1.0), inliers / (1 + r2 / bound**2))
    return pose


def _consensus(
    rows: np.ndarray, seed: int, first: int, second: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return members and weights of the two-stage consensus set of a seed.

    The first stage keeps the correspondences that share the most neighbours with the seed, the second
    those of them that share the most within this set. The weights are the leading eigenvector of their
    compatibilities.
    """
    shared = common_neighbours(rows, seed)
    near = np.argsort(-shared, kind="stable")[: first - 1]
    members = np.concatenate([[seed], near[shared[near] > 0]])
    local = submatrix(rows, members)
    among = local[0] * (local @ local)[0]
    among[0] = np.inf  # the seed stays
    kept = np.argsort(-among, kind="stable")[:second]
    kept = kept[among[kept] > 0]
    inner = local[np.ix_(kept, kept)]
    return members[kept], leading_eigenvector(inner * (inner @ inner))
