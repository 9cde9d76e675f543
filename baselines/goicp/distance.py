"""Exact nearest-neighbour distances from cells that list every point that can be nearest in them.

A point y can be nearest for some position in a cell with centre c and half-diagonal r only if
``|y - c| <= min_j |y_j - c| + 2 r`` (triangle inequality, twice). Listing those points per cell
makes a query a look-up and a scan of a few coordinates that lie side by side: the speed of a
distance transform without its discretisation, so that bounds made of it are true bounds.

Two grids of the same number of cells: a fine one around the target, and a coarse one that covers
every place a moved source point can reach. Elsewhere all points are scanned.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_MARGIN = 0.25  # of the fine grid, in half-widths of the target
_BLOCK = 4  # cells per axis that share one preliminary list


class Cells:
    """Distances to `target` (m, 3); fastest within `reach` of the origin along each axis."""

    def __init__(self, target: np.ndarray, reach: float, per_axis: int) -> None:
        target = np.ascontiguousarray(target, dtype=np.float64)
        low, high = target.min(axis=0), target.max(axis=0)
        centre, half = (low + high) / 2, float((high - low).max()) / 2
        fine = (1 + _MARGIN) * half + 1e-9 * (1 + reach)
        per_axis = max(_BLOCK, per_axis - per_axis % _BLOCK)
        parts = []
        for origin, width in ((centre - fine, 2 * fine), (np.full(3, -reach), 2 * reach)):
            starts, points = _build(target, origin, width / per_axis, per_axis)
            parts += [np.append(origin, per_axis / width), starts, points]
        # One tuple of arrays, as the kernels take it.
        self.arrays = (*parts, target, np.array([per_axis]))

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Distance of each point (n, 3) to the nearest target point."""
        return _distances(np.ascontiguousarray(points, dtype=np.float64), self.arrays)


@njit(cache=True)
def distance(x, y, z, cells):
    """Distance from a position to the nearest target point."""
    grid, starts, points, wide, wide_starts, wide_points, target, size = cells
    n = size[0]
    cell = _cell(x, y, z, grid, n)
    if cell >= 0:
        return _nearest(x, y, z, points, starts[cell], starts[cell + 1])
    cell = _cell(x, y, z, wide, n)
    if cell >= 0:
        return _nearest(x, y, z, wide_points, wide_starts[cell], wide_starts[cell + 1])
    return _nearest(x, y, z, target, 0, len(target))


@njit(cache=True)
def _cell(x, y, z, grid, n):
    i = np.floor((x - grid[0]) * grid[3])
    j = np.floor((y - grid[1]) * grid[3])
    k = np.floor((z - grid[2]) * grid[3])
    if i < 0 or j < 0 or k < 0 or i >= n or j >= n or k >= n:
        return -1
    return (int(i) * n + int(j)) * n + int(k)


@njit(cache=True)
def _nearest(x, y, z, points, start, stop):
    best = np.inf
    for p in range(start, stop):
        dx, dy, dz = x - points[p, 0], y - points[p, 1], z - points[p, 2]
        best = min(best, dx * dx + dy * dy + dz * dz)
    return np.sqrt(best)


@njit(cache=True)
def _distances(points, cells):
    found = np.empty(len(points))
    for i in range(len(points)):
        found[i] = distance(points[i, 0], points[i, 1], points[i, 2], cells)
    return found


@njit(cache=True)
def _build(target, origin, side, n):
    """Start of each cell's list (n^3 + 1) and the lists' coordinates, cells in C order."""
    m = len(target)
    blocks = n // _BLOCK
    everyone = np.arange(m)
    shared = np.empty(m, np.int64)
    listed = np.empty(m, np.int64)
    counts = np.zeros(n * n * n + 1, np.int64)
    points = np.empty((0, 3))
    for fill in range(2):
        if fill:
            points = np.empty((counts.sum(), 3))
            counts = np.cumsum(counts)
        for block in range(blocks**3):
            bi, bj, bk = block // blocks**2, block // blocks % blocks, block % blocks
            wide = _BLOCK * side
            n_shared = _candidates(
                target, everyone, m, origin[0] + (bi + 0.5) * wide, origin[1] + (bj + 0.5) * wide,
                origin[2] + (bk + 0.5) * wide, wide, shared,
            )  # fmt: skip
            for inside in range(_BLOCK**3):
                i = bi * _BLOCK + inside // _BLOCK**2
                j = bj * _BLOCK + inside // _BLOCK % _BLOCK
                k = bk * _BLOCK + inside % _BLOCK
                n_listed = _candidates(
                    target, shared, n_shared, origin[0] + (i + 0.5) * side,
                    origin[1] + (j + 0.5) * side, origin[2] + (k + 0.5) * side, side, listed,
                )  # fmt: skip
                cell = (i * n + j) * n + k
                if fill:
                    for p in range(n_listed):
                        points[counts[cell] + p] = target[listed[p]]
                else:
                    counts[cell + 1] = n_listed
    return counts, points


@njit(cache=True)
def _candidates(target, among, n_among, x, y, z, side, found):
    """Those of the listed points that can be nearest in the cell of this centre; their number."""
    squared = np.empty(n_among)
    for a in range(n_among):
        p = among[a]
        dx, dy, dz = x - target[p, 0], y - target[p, 1], z - target[p, 2]
        squared[a] = dx * dx + dy * dy + dz * dz
    # A cell's edge belongs to it up to rounding, hence the tiny excess.
    limit = (np.sqrt(squared.min()) + np.sqrt(3.0) * side) ** 2 * (1 + 1e-9)
    n_found = 0
    for a in range(n_among):
        if squared[a] <= limit:
            found[n_found] = among[a]
            n_found += 1
    return n_found
