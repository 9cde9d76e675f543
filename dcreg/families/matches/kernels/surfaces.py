"""Agreement of the surfaces of two clouds at a pose: near points with similar normals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.jit import jit, jit_part


class SurfaceGrid(NamedTuple):
    """A cloud with normals, and the nearest point to each cell of a grid around it.

    Attributes
    ----------
    points, normals : (m, 3) arrays
    origin : (3,) array
        Minimum vertex of the first cell.
    cell : float
    nearest : (A, B, C) int32 array
        Point nearest to the centre of a cell, -1 if none is near enough.
    """

    points: np.ndarray
    normals: np.ndarray
    origin: np.ndarray
    cell: float
    nearest: np.ndarray


@jit
def fill_nearest(points, origin, cell, reach, nearest, square):
    """Fill `nearest`, initially -1; `square` is a buffer of the same shape, initially infinite."""
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
    """Return the point stored for the cell of a position, -1: none."""
    a, b, c = u - grid.origin[0], v - grid.origin[1], w - grid.origin[2]
    if a < 0.0 or b < 0.0 or c < 0.0:
        return -1
    i0, i1, i2 = int(a / grid.cell), int(b / grid.cell), int(c / grid.cell)
    if i0 >= grid.nearest.shape[0] or i1 >= grid.nearest.shape[1] or i2 >= grid.nearest.shape[2]:
        return -1
    return grid.nearest[i0, i1, i2]


@jit_part
def moved_axis(T, a, p):
    """Return coordinate `a` of a moved point."""
    return T[a, 0] * p[0] + T[a, 1] * p[1] + T[a, 2] * p[2] + T[a, 3]


@jit_part
def pull(T, point, normal, grid, reach):
    """Return the point of the grid's cloud that attracts a moved point, and its weight (0: none).

    The weight is the product of the nearness 1 - (d / reach)^2 at distance d and the similarity cos 2a
    at an angle a between the normals, whose sign does not count. It is 0 if either factor is negative.
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
        rotated = T[a, 0] * normal[0] + T[a, 1] * normal[1] + T[a, 2] * normal[2]
        along += grid.normals[j, a] * rotated
    return j, near * max(0.0, 2.0 * along * along - 1.0)


@jit
def surface_scores(points, normals, grid, reach, poses, out):
    """Write the summed weights of all points for (P, 3, 4) poses."""
    for p in range(poses.shape[0]):
        out[p] = 0.0
        for i in range(points.shape[0]):
            _, strength = pull(poses[p], points[i], normals[i], grid, reach)
            out[p] += strength


@jit
def surface_pulls(points, normals, grid, reach, T, columns, weights):
    """Write, for each point, the point that attracts it at the pose T, and its weight."""
    for i in range(points.shape[0]):
        columns[i], weights[i] = pull(T, points[i], normals[i], grid, reach)
