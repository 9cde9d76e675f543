"""Rotation matrices of quaternions, and functions shared by bounds over rotations and over poses.

A rotation is a nonzero quaternion q = (w, x, y, z); q, -q and 2q are the same rotation.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.jit import jit, jit_inner


@jit
def chord_matrix(q, r):
    """Fill the image of (q r^T + r q^T) / (2 q.r) under the linear map from q q^T, |q| = 1, to R(q).

    It is R(q) if q = r, otherwise a matrix that is not a rotation.
    """
    scale = 0.5 / (q[0] * r[0] + q[1] * r[1] + q[2] * r[2] + q[3] * r[3])
    Q = np.empty((4, 4))
    for a in range(4):
        for b in range(4):
            Q[a, b] = (q[a] * r[b] + q[b] * r[a]) * scale
    M = np.empty((3, 3))
    M[0, 0] = Q[0, 0] + Q[1, 1] - Q[2, 2] - Q[3, 3]
    M[0, 1] = 2.0 * (Q[1, 2] - Q[0, 3])
    M[0, 2] = 2.0 * (Q[1, 3] + Q[0, 2])
    M[1, 0] = 2.0 * (Q[1, 2] + Q[0, 3])
    M[1, 1] = Q[0, 0] - Q[1, 1] + Q[2, 2] - Q[3, 3]
    M[1, 2] = 2.0 * (Q[2, 3] - Q[0, 1])
    M[2, 0] = 2.0 * (Q[1, 3] - Q[0, 2])
    M[2, 1] = 2.0 * (Q[2, 3] + Q[0, 1])
    M[2, 2] = Q[0, 0] - Q[1, 1] - Q[2, 2] + Q[3, 3]
    return M


@jit_inner
def transform(M, points, out):
    """Write M points to `out`, both (3, n)."""
    for i in range(points.shape[1]):
        x, y, z = points[0, i], points[1, i], points[2, i]
        out[0, i] = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z
        out[1, i] = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z
        out[2, i] = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z


@jit_inner
def extent(points):
    """Return the RMS and the maximum length of (3, n) points."""
    square = most = 0.0
    for i in range(points.shape[1]):
        own = points[0, i] ** 2 + points[1, i] ** 2 + points[2, i] ** 2
        square += own
        most = max(most, own)
    return math.sqrt(square / points.shape[1]), math.sqrt(most)


@jit_inner
def matched_cost(moved, target, col_of):
    """Return the sum of squared residuals of given pairs."""
    total = 0.0
    for i in range(col_of.size):
        j = col_of[i]
        if j >= 0:
            for c in range(3):
                total += (moved[c, i] - target[c, j]) ** 2
    return total


def rotation_matrix(q):
    """Return the rotation matrix of a quaternion."""
    return chord_matrix(q, q)


def best_rotation(source, target):
    """Fit a rotation to paired (3, k) points without centring; return its quaternion (Horn 1987).

    It is the eigenvector of the largest eigenvalue of a symmetric 4x4 matrix, and never a reflection.
    """
    G = source @ target.T
    N = np.empty((4, 4))
    N[0, 0] = G[0, 0] + G[1, 1] + G[2, 2]
    N[1, 1] = G[0, 0] - G[1, 1] - G[2, 2]
    N[2, 2] = G[1, 1] - G[0, 0] - G[2, 2]
    N[3, 3] = G[2, 2] - G[0, 0] - G[1, 1]
    N[0, 1] = N[1, 0] = G[1, 2] - G[2, 1]
    N[0, 2] = N[2, 0] = G[2, 0] - G[0, 2]
    N[0, 3] = N[3, 0] = G[0, 1] - G[1, 0]
    N[1, 2] = N[2, 1] = G[0, 1] + G[1, 0]
    N[1, 3] = N[3, 1] = G[0, 2] + G[2, 0]
    N[2, 3] = N[3, 2] = G[1, 2] + G[2, 1]
    return np.ascontiguousarray(np.linalg.eigh(N)[1][:, 3])
