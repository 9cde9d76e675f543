"""The least-squares pose of paired points."""

from __future__ import annotations

import numpy as np


def fit_pose(
    source: np.ndarray,
    target: np.ndarray,
    scale_range: tuple[float, float],
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """Least-squares pose of paired points (Umeyama 1991), scale clipped to `scale_range`.

    The rotation is proper (determinant +1) also for mirrored or degenerate data. It is the best one for
    every scale, and the cost a convex parabola in the scale: clipping gives the constrained optimum.

    Parameters
    ----------
    source, target : (..., k, d) arrays
        Leading axes hold further problems, fitted side by side.
    scale_range : (low, high)
        Of points that all coincide any scale is as good; they get `low`.
    weights : (..., k) array, optional
        Of the squared residuals, not all zero; default: equal.

    Returns
    -------
    (..., d+1, d+1) array
    """
    d = source.shape[-1]
    if weights is None:
        mean_x, mean_y = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
        x, y = source - mean_x, target - mean_y
        weighted_x = x
    else:
        shares = (weights / weights.sum(axis=-1, keepdims=True))[..., None, :]
        mean_x, mean_y = shares @ source, shares @ target
        x, y = source - mean_x, target - mean_y
        weighted_x = np.swapaxes(shares, -1, -2) * x
    u, singular, vt = np.linalg.svd(np.swapaxes(y, -1, -2) @ weighted_x)
    sign = np.ones_like(singular)
    sign[..., -1] = np.where(np.linalg.det(u) * np.linalg.det(vt) > 0, 1.0, -1.0)
    rotation = (u * sign[..., None, :]) @ vt
    spread = (weighted_x * x).sum(axis=(-2, -1))
    low, high = scale_range
    gain = (singular * sign).sum(axis=-1)
    scale = np.clip(gain / np.where(spread > 0, spread, np.inf), low, high)
    T = np.zeros((*singular.shape[:-1], d + 1, d + 1))
    T[..., :d, :d] = scale[..., None, None] * rotation
    T[..., :d, d] = (mean_y - mean_x @ np.swapaxes(T[..., :d, :d], -1, -2))[..., 0, :]
    T[..., d, d] = 1.0
    return T
