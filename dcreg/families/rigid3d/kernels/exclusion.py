"""Bounds over a region of poses, by distances of the moved source from the target.

`dcreg.families.rigid3d.cover` proves them. A region is an ellipsoid around a pose, seen in the principal
frame of a source triple: a point z moves by t' + w x z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import cleared, kth_smallest
from dcreg.jit import jit, jit_inner, jit_part, jit_reduction

_LEVELS = 2.0, 4.0, 8.0  # tau of the row test, as multiples of goal / k
_LEVEL = 0.7  # tau of the joint test, as a multiple of the k-th smallest cost
_INSIDE = 1e-6  # in cells; keeps a number below that of the cells
_SQUARINGS = 4  # of a matrix, whose 16-th power bounds its eigenvalue within 12 %


class Distances(NamedTuple):
    """Lower bounds on the distance to the target, on a grid of cells that contains the target.

    Attributes
    ----------
    origin : (3,) array
        The minimum vertex of the grid.
    cell : float
        Side of a cell.
    values : (a, b, c) float32 array
        The distance of the centre of the cell from the nearest target point.
    """

    origin: np.ndarray
    cell: float
    values: np.ndarray


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
    points : (3, n) array
    rotation_squares : (n,) array
        In an `Ellipsoid` the squared displacement of a point is at most ``shift_square + rotation_factor
        * rotation_squares[i]``.
    squares : (n,) array
        From below, the squared distances from the target at the centre of a region, or reduced costs.
    cells : (n,) int32 array
        Scratch of `fill_distances`.
    parts : (2, n) array
        The same.
    """

    points: np.ndarray
    rotation_squares: np.ndarray
    squares: np.ndarray
    cells: np.ndarray
    parts: np.ndarray


@jit_part
def allocate_rows(points):
    """Allocate rows for these points."""
    n = points.shape[1]
    return Rows(points, np.empty(n), np.empty(n), np.empty(n, np.int32), np.empty((2, n)))


@jit_inner
def fill_distances(rows, B, centroid, field):
    """Fill ``rows.squares`` at the pose that moves the triple by B to `centroid`.

    A point outside the grid is projected onto it. The segment to its projection and that from there to
    any target point include at least a right angle, so the squares of their lengths are added. Separate
    loops around the lookup let the compiler vectorise the rest.
    """
    x, y, z = rows.points[0], rows.points[1], rows.points[2]
    cells, off, outside = rows.cells, rows.parts[0], rows.parts[1]
    values, squares, cell, unit = field.values, rows.squares, field.cell, 1.0 / field.cell
    n0, n1, n2 = values.shape
    a, b, c = B[0, 0] * unit, B[0, 1] * unit, B[0, 2] * unit
    d, e, f = B[1, 0] * unit, B[1, 1] * unit, B[1, 2] * unit
    g, h, q = B[2, 0] * unit, B[2, 1] * unit, B[2, 2] * unit
    s0 = (centroid[0] - field.origin[0]) * unit
    s1 = (centroid[1] - field.origin[1]) * unit
    s2 = (centroid[2] - field.origin[2]) * unit
    last0, last1, last2 = n0 - _INSIDE, n1 - _INSIDE, n2 - _INSIDE
    for i in range(cells.size):
        u = a * x[i] + b * y[i] + c * z[i] + s0
        v = d * x[i] + e * y[i] + f * z[i] + s1
        w = g * x[i] + h * y[i] + q * z[i] + s2
        i0 = min(max(u, 0.0), last0)
        i1 = min(max(v, 0.0), last1)
        i2 = min(max(w, 0.0), last2)
        outside[i] = (u - i0) * (u - i0) + (v - i1) * (v - i1) + (w - i2) * (w - i2)
        c0, c1, c2 = np.int32(i0), np.int32(i1), np.int32(i2)
        cells[i] = (c0 * np.int32(n1) + c1) * np.int32(n2) + c2
        i0, i1, i2 = i0 - c0 - 0.5, i1 - c1 - 0.5, i2 - c2 - 0.5
        off[i] = math.sqrt(i0 * i0 + i1 * i1 + i2 * i2)
    flat = values.reshape(-1)
    for i in range(cells.size):
        squares[i] = flat[np.uintp(cells[i])]
    for i in range(cells.size):
        near = max(0.0, squares[i] - cell * off[i])
        squares[i] = near * near + cell * cell * outside[i]


@jit_reduction
def _depths(rows, region, t0, t1, t2):
    """Return for three levels how far the costs less displacements are below them in total."""
    squares, rotation_squares = rows.squares, rows.rotation_squares
    shift_square, rotation_factor = region.shift_square, region.rotation_factor
    w0 = w1 = w2 = 0.0
    for i in range(squares.size):
        net = squares[i] - shift_square - rotation_factor * rotation_squares[i]
        w0 += max(0.0, t0 - net)
        w1 += max(0.0, t1 - net)
        w2 += max(0.0, t2 - net)
    return w0, w1, w2


@jit_inner
def rows_exclude(rows, k, goal, region):
    """Tell whether row by row no optimum of a region has an objective below the cutoff.

    The sum of the k smallest ``rows.squares`` less displacements has to reach `goal`.
    """
    level = goal / k
    t0, t1, t2 = _LEVELS[0] * level, _LEVELS[1] * level, _LEVELS[2] * level
    w0, w1, w2 = _depths(rows, region, t0, t1, t2)
    return max(k * t0 - w0, k * t1 - w1, k * t2 - w2) >= goal


@jit
def _joint_loss(rows, tau, region):
    """Return an upper bound on sum max(0, |displacement|^2 - square + tau) - max(0, tau - square).

    The displacements are those of one pose of the region. The bound is the maximum eigenvalue of a 6 x 6
    matrix, from above by the trace of its 16-th power.
    """
    points, rotation_squares, squares = rows.points, rows.rotation_squares, rows.squares
    shift_square, rotation_factor, inverse = region
    A, P, moments = cleared(np.empty((6, 6))), np.empty((6, 6)), cleared(np.empty((4, 4)))
    for i in range(squares.size):
        over, most = squares[i] - tau, shift_square + rotation_factor * rotation_squares[i]
        if over >= most:
            continue
        share = 1.0 if over <= 0.0 else 1.0 - over / most
        u, v, w = points[0, i], points[1, i], points[2, i]
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


@jit_inner
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


@jit_inner
def fill_displacements(rows, inverse):
    """Fill ``rows.rotation_squares``: the maximum eigenvalues of [z]^T M^-1 [z], for inverse moments."""
    points, rotation_squares = rows.points, rows.rotation_squares
    for i in range(rotation_squares.size):
        u, v, w = points[0, i], points[1, i], points[2, i]
        a = w * w * inverse[1] + v * v * inverse[2]
        b = w * w * inverse[0] + u * u * inverse[2]
        c = v * v * inverse[0] + u * u * inverse[1]
        trace = a + b + c
        minors = a * b + b * c + a * c
        minors -= (u * v * inverse[2]) ** 2 + (u * w * inverse[1]) ** 2 + (v * w * inverse[0]) ** 2
        rotation_squares[i] = 0.5 * (trace + math.sqrt(max(0.0, trace * trace - 4.0 * minors)))
