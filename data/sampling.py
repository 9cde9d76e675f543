"""Small deterministic operations on point sets."""

from __future__ import annotations

import numpy as np

from dcreg.problem import farthest_point_order
from dcreg.problem.geometry import fit_pose


def normalise(points: np.ndarray) -> np.ndarray:
    """Centre the bounding box at the origin and scale its longest side to 1."""
    low, high = points.min(axis=0), points.max(axis=0)
    return (points - (low + high) / 2) / (high - low).max()


def farthest_points(points: np.ndarray, n: int) -> np.ndarray:
    """Return the indices of `n` points, each the farthest from those before it.

    The first is the point farthest from the centroid; ties go to the lower index.
    """
    if n > len(points):
        raise ValueError(f"n={n} exceeds the {len(points)} points of the set; request fewer")
    first = int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
    return farthest_point_order(points, n, first)


def voxel_downsample(points: np.ndarray, size: float) -> np.ndarray:
    """Return the mean of the points in every occupied cell of a grid of cubes with side `size`."""
    cells = np.floor(points / size).astype(np.int64)
    _, cell_of, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), points.shape[1]))
    np.add.at(sums, cell_of.ravel(), points)
    return sums / counts[:, None]


def mutual_nearest(a: np.ndarray, b: np.ndarray, tolerance: float) -> np.ndarray:
    """Return pairs (i, j) of mutual nearest neighbours at most `tolerance` apart."""
    from scipy.spatial import cKDTree  # takes long to load; a plan needs no points

    distance, j_of_i = cKDTree(b).query(a)
    _, i_of_j = cKDTree(a).query(b)
    i = np.flatnonzero((i_of_j[j_of_i] == np.arange(len(a))) & (distance <= tolerance))
    return np.column_stack([i, j_of_i[i]])


def reference_pose(
    source: np.ndarray, target: np.ndarray, pairs: np.ndarray, scale_range: tuple[float, float]
) -> np.ndarray:
    """Return the admissible least-squares pose over the true pairs: the reference of all errors.

    It differs from the pose that was applied, since deformation and noise contain a motion.
    """
    return fit_pose(source[pairs[:, 0]], target[pairs[:, 1]], scale_range)
