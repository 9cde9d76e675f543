"""Points and rotations in 3D, in NumPy."""

from __future__ import annotations

import numpy as np


def squared_distances(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return (..., n, m) squared distances of (..., n, 3) and (..., m, 3) points."""
    costs = x @ y.swapaxes(-1, -2)
    costs *= -2.0
    costs += (x**2).sum(axis=-1)[..., :, None]
    costs += (y**2).sum(axis=-1)[..., None, :]
    return np.maximum(costs, 0.0, out=costs)


def plus_duals(
    x: np.ndarray, y: np.ndarray, duals: np.ndarray, precision: type[np.floating] = np.float64
) -> np.ndarray:
    """Return (B, n, m) squared distances of (B, n, 3) and (m, 3) points plus (B, m) duals.

    One product of matrices, with (-2 x, |x|^2, 1) and (y, 1, |y|^2 + dual).
    """
    left = np.ones((*x.shape[:2], 5), precision)
    left[..., :3] = -2.0 * x
    left[..., 3] = (x**2).sum(axis=2)
    right = np.ones((len(x), 5, len(y)), precision)
    right[:, :3] = y.T
    right[:, 4] = (y**2).sum(axis=1) + duals
    return left @ right


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product along the last axis; faster than NumPy's."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        out[..., axis] = a[..., one] * b[..., other] - a[..., other] * b[..., one]
    return out


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return the (B, 3, 3) rotations of quaternions of any length."""
    w, x, y, z = quaternions.T / np.linalg.norm(quaternions, axis=1)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)
