"""Bounds over a region of poses, by distances of the moved source from the target.

`dcreg.families.rigid3d.cover` proves them. A region is an ellipsoid around a pose, seen in the principal
frame of a source triple: a point z moves by t' + w x z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import cleared, kth_smallest
from dcreg.jit import jit, jit_part

_LEVELS = 2.0, 4.0, 8.0  # tau of the row test, as multiples of goal / k
_LEVEL = 0.7  # tau of the joint test, as a multiple of the k-th smallest cost
_SQUARINGS = 4  # of a matrix, whose 16-th power bounds its eigenvalue within 12 %


class Distances(NamedTuple):
    """Lower bounds on the distance to the target, on a grid of cells.

    Attributes
    ----------
    origin : (3,) array
        The minimum vertex of the grid.
    cell : float
        Side of a cell.
    values : (a, b, c) float32 array
        The distance of the centre of the cell from the nearest target point.
    lower, upper : (3,) arrays
        The bounding box of the target, for points outside the grid.
    """

    origin: np.ndarray
    cell: float
    values: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@jit_part
def _distance(field, x, y, z):
    """Return a lower bound on the distance of a point from the target."""
    a, b, c = x - field.origin[0], y - field.origin[1], z - field.origin[2]
    a, b, c = a / field.cell, b / field.cell, c / field.cell
    n0, n1, n2 = field.values.shape
    if a < 0.0 or b < 0.0 or c < 0.0 or a >= n0 or b >= n1 or c >= n2:
        a = max(field.lower[0] - x, 0.0, x - field.upper[0])
        b = max(field.lower[1] - y, 0.0, y - field.upper[1])
        c = max(field.lower[2] - z, 0.0, z - field.upper[2])
        return math.sqrt(a * a + b * b + c * c)
    i, j, k = int(a), int(b), int(c)
    a, b, c = a - i - 0.5, b - j - 0.5, c - k - 0.5
    return max(0.0, field.values[i, j, k] - field.cell * math.sqrt(a * a + b * b + c * c))


class Ellipsoid(NamedTuple):
    """A region of poses.

    Attributes
    ----------
    shift_square : float
        Square of the semi-axis of t', a squared length. `Regions.shift_radius` is the semi-axis itself.
    rotation_factor : float
        Factor of the squared semi-axes of w, which are ``rotation_factor * inverse``, without unit.
    inverse : (3,) array
        Inverse moments of inertia, or the squared semi-axes themselves with a factor of 1.
    """

    shift_square: float
    rotation_factor: float
    inverse: np.ndarray


class Rows(NamedTuple):
    """The source points in the principal frame of a triple.

    Attributes
    ----------
    points : (n, 3) array
    rotation_squares : (n,) array
        In an `Ellipsoid` the squared displacement of a point is at most ``shift_square + rotation_factor
        * rotation_squares[i]``.
    squares : (n,) array
        From below, the squared distances from the target at the centre of a region, or reduced costs.
    """

    points: np.ndarray
    rotation_squares: np.ndarray
    squares: np.ndarray


@jit
def rows_exclude(rows, B, centroid, field, k, goal, region):
    """Tell whether row by row no optimum of a region has an objective below the cutoff.

    Fills ``rows.squares`` with the distances at the pose that moves the triple by B to `centroid`. The
    sum of the k smallest costs less displacements has to reach `goal`.
    """
    points, rotation_squares, squares = rows
    shift_square, rotation_factor, level = region.shift_square, region.rotation_factor, goal / k
    t0, t1, t2 = _LEVELS[0] * level, _LEVELS[1] * level, _LEVELS[2] * level
    w0 = w1 = w2 = 0.0
    for i in range(points.shape[0]):
        u, v, w = points[i, 0], points[i, 1], points[i, 2]
        d = _distance(
            field,
            B[0, 0] * u + B[0, 1] * v + B[0, 2] * w + centroid[0],
            B[1, 0] * u + B[1, 1] * v + B[1, 2] * w + centroid[1],
            B[2, 0] * u + B[2, 1] * v + B[2, 2] * w + centroid[2],
        )
        squares[i] = d * d
        net = d * d - shift_square - rotation_factor * rotation_squares[i]
        w0 += max(0.0, t0 - net)
        w1 += max(0.0, t1 - net)
        w2 += max(0.0, t2 - net)
    return max(k * t0 - w0, k * t1 - w1, k * t2 - w2) >= goal


@jit
def _joint_loss(rows, tau, region):
    """Return an upper bound on sum max(0, |displacement|^2 - square + tau) - max(0, tau - square).

    The displacements are those of one pose of the region. The bound is the maximum eigenvalue of a 6 x 6
    matrix, from above by the trace of its 16-th power.
    """
    points, rotation_squares, squares = rows
    shift_square, rotation_factor, inverse = region
    A, P, moments = cleared(np.empty((6, 6))), np.empty((6, 6)), cleared(np.empty((4, 4)))
    for i in range(points.shape[0]):
        over, most = squares[i] - tau, shift_square + rotation_factor * rotation_squares[i]
        if over >= most:
            continue
        share = 1.0 if over <= 0.0 else 1.0 - over / most
        u, v, w = points[i, 0], points[i, 1], points[i, 2]
        moments[3, 3] += share
        moments[0, 3] += share * u
        moments[1, 3] += share * v
        moments[2, 3] += share * w
        moments[0, 0] += share * u * u
        moments[1, 1] += share * v * v
        moments[2, 2] += share * w * w
        moments[0, 1] += share * u * v
        moments[0, 2] += share * u * w
        moments[1, 2] += share * v * w
    trace = moments[0, 0] + moments[1, 1] + moments[2, 2]
    mixed = math.sqrt(shift_square * rotation_factor)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        A[a, a] = shift_square * moments[3, 3]
        A[3 + a, 3 + a] = rotation_factor * inverse[a] * (trace - moments[a, a])
        low, high = min(a, b), max(a, b)
        A[3 + a, 3 + b] = A[3 + b, 3 + a] = (
            -rotation_factor * math.sqrt(inverse[a] * inverse[b]) * moments[low, high]
        )
        # e_a x z has the components -z_c along b and z_b along c
        A[b, 3 + a] = A[3 + a, b] = -mixed * math.sqrt(inverse[a]) * moments[c, 3]
        A[c, 3 + a] = A[3 + a, c] = mixed * math.sqrt(inverse[a]) * moments[b, 3]
    scale = 0.0
    for a in range(6):
        scale += A[a, a]
    if scale <= 0.0:
        return 0.0
    for a in range(6):
        for b in range(6):
            A[a, b] /= scale
    for _ in range(_SQUARINGS):
        for a in range(6):
            for b in range(6):
                value = 0.0
                for c in range(6):
                    value += A[a, c] * A[c, b]
                P[a, b] = value
        A, P = P, A
    trace = 0.0
    for a in range(6):
        trace += A[a, a]
    return scale * trace ** (0.5**_SQUARINGS)


@jit
def jointly_excluded(rows, k, goal, region):
    """Tell whether no optimum of a region has an objective below the cutoff, with joint displacements."""
    squares = rows.squares
    tau = _LEVEL * kth_smallest(squares, k - 1)
    found = k * tau
    for i in range(squares.size):
        found -= max(0.0, tau - squares[i])
    if found < goal:
        return False
    return found - _joint_loss(rows, tau, region) >= goal


@jit
def fill_displacements(rows, inverse):
    """Fill ``rows.rotation_squares``: the maximum eigenvalues of [z]^T M^-1 [z], for inverse moments."""
    points, rotation_squares, _ = rows
    for i in range(points.shape[0]):
        u, v, w = points[i, 0], points[i, 1], points[i, 2]
        a = w * w * inverse[1] + v * v * inverse[2]
        b = w * w * inverse[0] + u * u * inverse[2]
        c = v * v * inverse[0] + u * u * inverse[1]
        trace = a + b + c
        minors = a * b + b * c + a * c
        minors -= (u * v * inverse[2]) ** 2 + (u * w * inverse[1]) ** 2 + (v * w * inverse[0]) ** 2
        rotation_squares[i] = 0.5 * (trace + math.sqrt(max(0.0, trace * trace - 4.0 * minors)))
