"""Exact nearest-neighbour distances from cells that list all points that can be nearest in them.

A point y can be nearest to some position in a cell with centre c and half-diagonal r only if
``|y - c| <= min_j |y_j - c| + 2 r`` (triangle inequality, twice). With a list of these points per cell
a query is a look-up and a scan of a few contiguous coordinates. It is as fast as a distance transform,
without discretisation, so its bounds are valid.

There are two grids with the same number of cells: a fine one around the target, and a coarse one that
covers all positions that a moved source point can reach. Elsewhere all points are scanned.
"""

from __future__ import annotations

import numpy as np

from baselines.goicp.kernels import BLOCK, all_distances, build

_MARGIN = 0.25  # of the fine grid, in half-widths of the target


class Cells:
    """Distances to `target` (m, 3); fast within `reach` of the origin along each axis."""

    def __init__(self, target: np.ndarray, reach: float, per_axis: int) -> None:
        target = np.ascontiguousarray(target, dtype=np.float64)
        low, high = target.min(axis=0), target.max(axis=0)
        centre, half = (low + high) / 2, float((high - low).max()) / 2
        fine = (1 + _MARGIN) * half + 1e-9 * (1 + reach)
        per_axis = max(BLOCK, per_axis - per_axis % BLOCK)
        parts = []
        for origin, width in ((centre - fine, 2 * fine), (np.full(3, -reach), 2 * reach)):
            starts, points = build(target, origin, width / per_axis, per_axis)
            parts += [np.append(origin, per_axis / width), starts, points]
        # One tuple of arrays, in the form of the kernels.
        self.arrays = (*parts, target, np.array([per_axis]))

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, 3) to the nearest target point."""
        return all_distances(np.ascontiguousarray(points, dtype=np.float64), self.arrays)
