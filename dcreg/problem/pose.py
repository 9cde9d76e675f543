"""What a homogeneous matrix says of its linear part: the scale, the rotation nearest to it, its angle."""

from __future__ import annotations

import math

import numpy as np


def scale_of(pose: np.ndarray) -> float:
    """Scale of a (d+1, d+1) pose: the d-th root of its linear part's determinant, without the sign."""
    d = len(pose) - 1
    return float(abs(np.linalg.det(pose[:d, :d])) ** (1.0 / d))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (determinant +1) nearest to a (d, d) matrix, and of largest inner product with it.

    Removes rounding and a scale, and solves Wahba's problem for ``sum target_i source_i^T``.
    """
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    sign = np.ones(len(u))
    sign[-1] = np.sign(np.linalg.det(u @ vt))
    return (u * sign) @ vt


def rotation_angle_deg(rotation: np.ndarray) -> float:
    """Angle of a (d, d) rotation in degrees: signed in the plane, about the axis in space.

    The arc tangent of sine and cosine keeps digits where the arc cosine has none, near 0 and 180 degrees.
    """
    if len(rotation) == 2:
        return math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))
    skew = rotation - rotation.T
    sine = math.sqrt(skew[0, 1] ** 2 + skew[0, 2] ** 2 + skew[1, 2] ** 2) / 2
    return math.degrees(math.atan2(sine, (np.trace(rotation) - 1) / 2))
