"""The least-squares pose of paired points."""

from __future__ import annotations

import numpy as np


def fit_pose(
    source: np.ndarray, target: np.ndarray, scale_range: tuple[float, float]
) -> np.ndarray:
    """Least-squares pose of paired points (Umeyama 1991), scale clipped to `scale_range`.

    The rotation is proper (determinant +1) also for mirrored or degenerate data.
    """
    d = source.shape[1]
    mean_x, mean_y = source.mean(axis=0), target.mean(axis=0)
    x, y = source - mean_x, target - mean_y
    u, singular, vt = np.linalg.svd(y.T @ x)
    sign = np.ones(d)
    sign[-1] = 1.0 if np.linalg.det(u) * np.linalg.det(vt) > 0 else -1.0
    rotation = (u * sign) @ vt
    spread = float((x**2).sum())
    low, high = scale_range
    scale = float(np.clip((singular * sign).sum() / spread, low, high)) if spread > 0 else low
    T = np.eye(d + 1)
    T[:d, :d] = scale * rotation
    T[:d, d] = mean_y - T[:d, :d] @ mean_x
    return T
