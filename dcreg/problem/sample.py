"""Fewer points, spread as evenly as they can be."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

_LOOKED_AT = 5000  # points, for the median distance to the next one
_NEIGHBOURS = 3
_ISOLATED = 6.0  # times the median distance to the third neighbour


def median_spacing(points: np.ndarray) -> float:
    """Median distance of a point to the next one, of at most `_LOOKED_AT` points; 0 for a single one."""
    if len(points) < 2:
        return 0.0
    some = points[:: -(-len(points) // _LOOKED_AT)]
    return float(np.median(cKDTree(points).query(some, k=2)[0][:, 1]))


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Rows of `count` points, each as far as possible from those before it (farthest-point sampling).

    The first is the point nearest to the centroid, so that the choice does not depend on the order of
    the points but for ties.

    Parameters
    ----------
    points : (n, d) array
    count : int

    Returns
    -------
    (min(count, n),) int array
        Ascending; all rows where there are no more than `count`.
    """
    if count >= len(points):
        return np.arange(len(points))
    chosen = np.empty(count, np.int64)
    chosen[0] = np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1))
    axes = np.ascontiguousarray(points.T)  # summed axis by axis, in a sixth of the time
    nearest = np.full(len(points), np.inf)
    for at in range(1, count):
        gaps = axes - axes[:, chosen[at - 1], None]
        np.minimum(nearest, (gaps * gaps).sum(axis=0), out=nearest)
        chosen[at] = np.argmax(nearest)
    return np.unique(chosen)


def isolated(points: np.ndarray) -> np.ndarray:
    """Which points lie far from all others, as stray ones of a scan do: less than half of them.

    Farthest points would be made of them.

    Parameters
    ----------
    points : (n, d) array

    Returns
    -------
    (n,) bool array
    """
    if len(points) <= _NEIGHBOURS:
        return np.zeros(len(points), dtype=bool)
    reach = cKDTree(points).query(points, k=_NEIGHBOURS + 1)[0][:, -1]
    usual = np.median(reach)
    alone: np.ndarray = (reach > _ISOLATED * usual) & (usual > 0.0)
    return alone


def representative_points(points: np.ndarray, count: int) -> np.ndarray:
    """Rows of `count` farthest points among those that are not `isolated`.

    Parameters
    ----------
    points : (n, d) array
    count : int

    Returns
    -------
    (C,) int array
        Ascending; C is less than `count` only where there are no more, and all rows where n is no more.
    """
    if count >= len(points):
        return np.arange(len(points))
    kept = np.flatnonzero(~isolated(points))
    return kept[farthest_points(points[kept], count)]
