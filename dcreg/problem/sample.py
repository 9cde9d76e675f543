"""Fewer points, spread as evenly as they can be."""

from __future__ import annotations

import numpy as np


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
    nearest = np.full(len(points), np.inf)
    for at in range(1, count):
        np.minimum(nearest, ((points - points[chosen[at - 1]]) ** 2).sum(axis=1), out=nearest)
        chosen[at] = np.argmax(nearest)
    return np.unique(chosen)
