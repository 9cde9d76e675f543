"""How well the surfaces of two clouds coincide at a pose: near points with like normals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.jit import jit, jit_part


class SurfaceGrid(NamedTuple):
    """A cloud with normals, and which of its points is nearest to every cell of a grid around it.

    Attributes
    ----------
    points, normals : (m, 3) arrays
    origin : (3,) array
        Corner of the first cell.
    cell : float
    nearest : (A, B, C) int32 array
        Point nearest to the centre of a cell, -1 where none is near enough.
    """

    points: np.ndarray
    normals: np.ndarray
    origin: np.ndarray
    cell: float
    nearest: np.ndarray


@jit
def fill_nearest(points, origin, cell, reach, nearest, square):
    """Fill `nearest`, which comes as -1; `square` of the same shape, as infinities, is for work."""
    farthest = reach + 0.9 * cell
    span = int(farthest / cell) + 1
    size_a, size_b, size_c = nearest.shape
    for j in range(points.shape[0]):
        x, y, z = points[j, 0] - origin[0], points[j, 1] - origin[1], points[j, 2] - origin[2]
        a, b, c = int(x / cell), int(y / cell), int(z / cell)
        for i0 in range(max(0, a - span), min(size_a, a + span + 1)):
            d0 = (i0 + 0.5) * cell - x
            for i1 in range(max(0, b - span), min(size_b, b + span + 1)):
                d1 = (i1 + 0.5) * cell - y
                for i2 in range(max(0, c - span), min(size_c, c + span + 1)):
                    d2 = (i2 + 0.5) * cell - z
                    apart = d0 * d0 + d1 * d1 + d2 * d2
                    if apart < square[i0, i1, i2] and apart < farthest * farthest:
                        square[i0, i1, i2] = apart
                        nearest[i0, i1, i2] = j


@jit_part
def partner(grid, u, v, w):
    """The point of the grid's cloud to look at for a point of space, -1: none."""
    a, b, c = u - grid.origin[0], v - grid.origin[1], w - grid.origin[2]
    if a < 0.0 or b < 0.0 or c < 0.0:
        return -1
    i0, i1, i2 = int(a / grid.cell), int(b / grid.cell), int(c / grid.cell)
    if i0 >= grid.nearest.shape[0] or i1 >= grid.nearest.shape[1] or i2 >= grid.nearest.shape[2]:
        return -1
    return grid.nearest[i0, i1, i2]


@jit_part
def moved_axis(T, a, p):
    """Coordinate `a` of a moved point."""
    return T[a, 0] * p[0] + T[a, 1] * p[1] + T[a, 2] * p[2] + T[a, 3]


@jit_part
def pull(T, point, normal, grid, reach):
    """The point of the grid's cloud to which a moved point is pulled, and how much; 0: not at all.

    At distance d the nearness is 1 - (d / reach)^2, at an angle a between the normals, whose sign does
    not count, the likeness cos 2a; the pull is their product, and 0 where one would be negative.
    """
    u, v, w = moved_axis(T, 0, point), moved_axis(T, 1, point), moved_axis(T, 2, point)
    j = partner(grid, u, v, w)
    if j < 0:
        return 0, 0.0
    q = grid.points[j]
    near = 1.0 - ((u - q[0]) ** 2 + (v - q[1]) ** 2 + (w - q[2]) ** 2) / (reach * reach)
    if near <= 0.0:
        return j, 0.0
    along = 0.0
    for a in range(3):
        turned = T[a, 0] * normal[0] + T[a, 1] * normal[1] + T[a, 2] * normal[2]
        along += grid.normals[j, a] * turned
    return j, near * max(0.0, 2.0 * along * along - 1.0)


@jit
def surface_scores(points, normals, grid, reach, poses, out):
    """For (P, 3, 4) poses the sum of the pulls of all points."""
    for p in range(poses.shape[0]):
        out[p] = 0.0
        for i in range(points.shape[0]):
            _, strength = pull(poses[p], points[i], normals[i], grid, reach)
            out[p] += strength


@jit
def surface_pulls(points, normals, grid, reach, T, columns, weights):
    """For every point the one it is pulled to at the pose T, and how much."""
    for i in range(points.shape[0]):
        columns[i], weights[i] = pull(T, points[i], normals[i], grid, reach)
