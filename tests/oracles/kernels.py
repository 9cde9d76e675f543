"""Plain NumPy/SciPy twins of the compiled kernels: the oracle of the tests, written to be read."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from dcreg.families.dc.space import FeatureSpace
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.search import Box
from tests.oracles.matchings import matchings


def k_assignment(cost: np.ndarray, k: int) -> float:
    """Cheapest k pairs by a padded square assignment.

    m - k dummy rows and n - k dummy columns take the unmatched; a dummy never meets a dummy.
    """
    n, m = cost.shape
    forbidden = 1e3 * (n + m) * (1.0 + np.abs(cost).max())
    padded = np.zeros((n + m - k, n + m - k))
    padded[:n, :m] = cost
    padded[n:, m:] = forbidden
    rows, columns = linear_sum_assignment(padded)
    return float(padded[rows, columns].sum())


def k_assignment_brute_force(cost: np.ndarray, k: int) -> float:
    """Cheapest k pairs by trying all of them; for a handful of rows and columns."""
    return min(cost[pairs].sum() for pairs in matchings(*cost.shape, k))


def features(space: FeatureSpace, theta: np.ndarray) -> np.ndarray:
    """(n, q) features of the source moved by `theta`."""
    if isinstance(space, Similarity2D):
        a, b, tx, ty = theta
        return space.source @ np.array([[a, b], [-b, a]]) + [tx, ty]
    return np.linalg.norm(space.source + theta, axis=1, keepdims=True)


def costs(space: FeatureSpace, theta: np.ndarray) -> np.ndarray:
    """(n, m) squared distances of features at `theta`."""
    moved = features(space, theta)
    target = np.atleast_2d(space.clouds.target)  # points by axis, or norms
    return ((moved[:, None, :] - target.T[None]) ** 2).sum(axis=-1)


def objective(space: FeatureSpace, theta: np.ndarray) -> float:
    """E(theta): the cheapest matching of features."""
    return k_assignment(costs(space, theta), space.n_inliers)


def curvature(space: FeatureSpace, delta: np.ndarray) -> np.ndarray:
    """|J_i delta|^2; in norm space J_i is the identity."""
    if isinstance(space, Similarity2D):
        return (features(space, delta) ** 2).sum(axis=1)  # features are linear in theta
    return np.full(len(space.source), float(delta @ delta))


def paper_bound(space: FeatureSpace, box: Box) -> float:
    """min over vertices of the k-assignment of E_ij(v) - R_i(v - centre)."""
    return min(
        k_assignment(
            costs(space, vertex) - curvature(space, vertex - box.centre)[:, None], space.n_inliers
        )
        for vertex in box.vertices()
    )
