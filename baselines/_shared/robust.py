"""Robust fits to correspondences with outliers: weighted, and by graduated non-convexity."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dcreg.problem import apply_pose, nearest_rotation
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

# Truncated least squares by graduated non-convexity (Yang, Antonante, Tzoumas and Carlone, 2020).
GNC_FACTOR = 1.4
GNC_ITERATIONS = 100
GNC_COST_CHANGE = 1e-9  # in squared bounds


def gnc(
    fit: Callable[[np.ndarray], np.ndarray],
    squared_residuals: Callable[[np.ndarray], np.ndarray],
    n: int,
    bound: float,
    budget: Budget,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Minimise ``sum(min(r^2, bound^2))``, from a convex to the truncated cost in steps of `GNC_FACTOR`.

    Parameters
    ----------
    fit
        The minimiser for given weights.
    squared_residuals
        The squared residuals of a minimiser.

    Returns
    -------
    minimiser, weights, finished
        Weights above one half are inliers. It starts from equal weights and usually finds the global
        minimum, without a certificate.
    """
    weights = np.ones(n)
    best = fit(weights)
    r2 = squared_residuals(best)
    limit = bound**2
    ratio = 2 * r2.max() / limit - 1
    if ratio <= 0:  # the surrogate is convex: all are inliers
        return best, weights, True
    mu, cost = 1 / ratio, np.inf
    for _ in range(GNC_ITERATIONS):
        with np.errstate(divide="ignore"):
            weights = np.clip(np.sqrt(limit * mu * (mu + 1) / r2) - mu, 0.0, 1.0)
        if weights.sum() <= 0:
            break
        best = fit(weights)
        r2 = squared_residuals(best)
        before, cost = cost, float(weights @ r2)
        mu *= GNC_FACTOR
        if abs(before - cost) < GNC_COST_CHANGE * limit:
            break
        if budget.is_over:
            return best, weights, False
    return best, weights, True


def gnc_rotation(
    source: np.ndarray, target: np.ndarray, bound: float, budget: Budget
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the rotation between vectors with outliers; see `gnc`."""
    return gnc(
        lambda weights: nearest_rotation((weights[:, None] * target).T @ source),
        lambda rotation: ((source @ rotation.T - target) ** 2).sum(axis=1),
        len(source),
        bound,
        budget,
    )


def gnc_pose(
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    scale_range: tuple[float, float],
    budget: Budget,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the pose between points with outliers; see `gnc`."""
    return gnc(
        lambda weights: fit_pose(source, target, scale_range, weights),
        lambda pose: squared_residuals(pose, source, target),
        len(source),
        bound,
        budget,
    )


def squared_residuals(pose: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the squared distances of the moved source to the target, row by row."""
    return ((apply_pose(pose, source) - target) ** 2).sum(axis=1)


def refit(
    pose: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    scale_range: tuple[float, float] = (1.0, 1.0),
    iterations: int = 20,
) -> np.ndarray:
    """Fit the correspondences within `bound` by least squares, as long as their number grows."""
    count = int((squared_residuals(pose, source, target) <= bound**2).sum())
    for _ in range(iterations):
        near = squared_residuals(pose, source, target) <= bound**2
        if near.sum() < source.shape[1]:
            return pose
        better = fit_pose(source[near], target[near], scale_range)
        n_near = int((squared_residuals(better, source, target) <= bound**2).sum())
        if n_near <= count:
            return better if n_near == count else pose
        pose, count = better, n_near
    return pose
