"""Fits to correspondences of which some are wrong: weighted, and by graduated non-convexity."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from baselines._shared.poses import apply, homogeneous

# Truncated least squares by graduated non-convexity (Yang, Antonante, Tzoumas and Carlone, 2020).
GNC_FACTOR = 1.4
GNC_ITERATIONS = 100
GNC_COST_CHANGE = 1e-9  # in squared bounds


def weighted_pose(
    source: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray,
    scale_range: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Pose of least weighted squared residuals, its scale clipped to `scale_range`."""
    total = weights.sum()
    mean_source, mean_target = weights @ source / total, weights @ target / total
    centred = source - mean_source
    rotation, gain = _aligned((weights[:, None] * (target - mean_target)).T @ centred)
    spread = float(weights @ (centred**2).sum(axis=1))
    scale = float(np.clip(gain / spread if spread > 0 else 1.0, *scale_range))
    return homogeneous(scale, rotation, mean_target - scale * rotation @ mean_source)


def weighted_rotation(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rotation of least weighted squared residuals (Wahba's problem)."""
    return _aligned((weights[:, None] * target).T @ source)[0]


def _aligned(cross: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation R that maximises ``trace(R.T @ cross)``, and that maximum."""
    u, singular, vt = np.linalg.svd(cross)
    sign = np.ones(len(singular))
    sign[-1] = np.sign(np.linalg.det(u @ vt))
    return (u * sign) @ vt, float(singular @ sign)


def gnc(
    fit: Callable[[np.ndarray], np.ndarray],
    squared_residuals: Callable[[np.ndarray], np.ndarray],
    n: int,
    bound: float,
    deadline: float = np.inf,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Minimise ``sum(min(r^2, bound^2))``: from convex to truncated in steps of `GNC_FACTOR`.

    Parameters
    ----------
    fit
        The minimiser for given weights.
    squared_residuals
        Those of a minimiser.

    Returns
    -------
    minimiser, weights, finished
        Weights above one half are inliers. It starts from equal weights and finds a good minimum,
        mostly the best; that is no certificate.
    """
    weights = np.ones(n)
    best = fit(weights)
    r2 = squared_residuals(best)
    limit = bound**2
    ratio = 2 * r2.max() / limit - 1
    if ratio <= 0:  # so near that the surrogate is convex: all are inliers
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
        if time.perf_counter() > deadline:
            return best, weights, False
    return best, weights, True


def gnc_rotation(
    source: np.ndarray, target: np.ndarray, bound: float, deadline: float = np.inf
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Rotation between vectors of which some are wrong; see `gnc`."""
    return gnc(
        lambda weights: weighted_rotation(source, target, weights),
        lambda rotation: ((source @ rotation.T - target) ** 2).sum(axis=1),
        len(source),
        bound,
        deadline,
    )


def gnc_pose(
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    scale_range: tuple[float, float] = (1.0, 1.0),
    deadline: float = np.inf,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Pose between points of which some are wrong; see `gnc`."""
    return gnc(
        lambda weights: weighted_pose(source, target, weights, scale_range),
        lambda pose: squared_residuals(pose, source, target),
        len(source),
        bound,
        deadline,
    )


def squared_residuals(pose: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Squared distances of the moved source to the target, row by row."""
    return ((apply(pose, source) - target) ** 2).sum(axis=1)


def refit(
    pose: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    scale_range: tuple[float, float] = (1.0, 1.0),
    iterations: int = 20,
) -> np.ndarray:
    """Least squares over the correspondences within `bound`, as long as their number grows."""
    count = int((squared_residuals(pose, source, target) <= bound**2).sum())
    for _ in range(iterations):
        near = squared_residuals(pose, source, target) <= bound**2
        if near.sum() < source.shape[1]:
            return pose
        better = weighted_pose(source, target, near.astype(float), scale_range)
        n_near = int((squared_residuals(better, source, target) <= bound**2).sum())
        if n_near <= count:
            return better if n_near == count else pose
        pose, count = better, n_near
    return pose
