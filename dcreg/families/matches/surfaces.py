"""The surface score: how well the surfaces of both clouds coincide.

A wrong pose often agrees with more matches than the right one, because many of the thousands of feature
matches agree by chance. Hardly any wrong pose also aligns the surfaces, which means that near points
have similar normals.
"""

from __future__ import annotations

import numpy as np

from dcreg.families.matches.kernels.surfaces import (
    SurfaceGrid,
    fill_nearest,
    surface_pulls,
    surface_scores,
)
from dcreg.families.matches.problem import MIN_MATCHES
from dcreg.problem.geometry import fit_pose
from dcreg.problem.trees import Tree

NEIGHBOURS = 16  # of a point; its normal is that of the plane through them
MAX_CELLS = 256  # of the grid along an axis
CELLS_PER_REACH = 2.0
MAX_SOURCE, MAX_TARGET = 5_000, 100_000  # points of larger clouds, drawn at random
OUTLIER_SHARE = 0.005  # of the points, on either side of an axis
MAX_LOOKED = 400  # source points used to score many poses
MAX_PULLED = 1000  # source points of a descent
WIDE = 2.0  # initial distance, in reaches, up to which points attract each other
WIDE_STEPS, STEPS = 10, 10
TINY = 1e-300  # avoids a division by zero


class Surfaces:
    """Two clouds and their normals; a pose is scored by the source points that lie on the target.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    reach : float
        Distance beyond which two points do not lie on one surface.
    """

    def __init__(self, source: np.ndarray, target: np.ndarray, reach: float) -> None:
        self._reach = reach
        self._points, self._normals = _some(source, MAX_SOURCE)
        target, normals = _some(target, MAX_TARGET)
        farthest = WIDE * reach
        origin, end = _box(target)
        origin -= farthest
        extent = end + farthest - origin
        cell = max(reach / CELLS_PER_REACH, float(extent.max()) / MAX_CELLS)
        shape = tuple((extent / cell).astype(int) + 1)
        nearest, square = np.full(shape, -1, np.int32), np.full(shape, np.inf)
        fill_nearest(target, origin, cell, farthest, nearest, square)
        self._grid = SurfaceGrid(target, normals, origin, cell, nearest)

    def scores(self, poses: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Return the number of source points on the target for (P, 3, 4) poses; `quick`: of a sample.

        A point is weighted by its distance and by the similarity of the normals.
        """
        looked = slice(MAX_LOOKED if quick else None)
        out = np.empty(len(poses))
        surface_scores(
            self._points[looked], self._normals[looked], self._grid, self._reach,
            np.ascontiguousarray(poses), out,
        )  # fmt: skip
        return out

    def descend(self, pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return a pose with a better product of surface score and match score; first in a wide reach.

        `x` and `y` are the points of matches. A step fits the pose to near points and near matches. The
        total weight of either kind is 1, as in the gradient of the logarithm of the product. Without
        matches, the pose slides along surfaces in contact, such as walls and floors.
        """
        points, normals = self._points[:MAX_PULLED], self._normals[:MAX_PULLED]
        columns, pulls = np.empty(len(points), np.int64), np.empty(len(points))
        for reach, steps in ((WIDE * self._reach, WIDE_STEPS), (self._reach, STEPS)):
            for _ in range(steps):
                pose = np.ascontiguousarray(pose)
                surface_pulls(points, normals, self._grid, reach, pose, columns, pulls)
                square = ((x @ pose[:, :3].T + pose[:, 3] - y) ** 2).sum(axis=1)
                gains = np.maximum(0.0, 1.0 - square / reach**2)
                near, agree = pulls > 0.0, gains > 0.0
                if near.sum() + agree.sum() < MIN_MATCHES:
                    return pose
                sides = (
                    np.concatenate([points[near], x[agree]]),
                    np.concatenate([self._grid.points[columns[near]], y[agree]]),
                )
                kinds = pulls[near], gains[agree]
                weights = np.concatenate([kind / max(kind.sum(), TINY) for kind in kinds])
                pose = fit_pose(*sides, (1.0, 1.0), weights)[:3]
        return pose


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a box around all points except outliers, which would require large cells."""
    low, high = np.quantile(points, [OUTLIER_SHARE, 1.0 - OUTLIER_SHARE], axis=0)
    margin = 0.5 * (high - low)
    return (
        np.maximum(points.min(axis=0), low - margin),
        np.minimum(points.max(axis=0), high + margin),
    )


def _some(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `count` of the points in random order, and their normals."""
    order = np.random.default_rng(0).permutation(len(points))[:count]
    some = np.ascontiguousarray(points[order])
    return some, normals_of(points, some)


def normals_of(points: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Return unit normals, of either sign, at some of the points: of planes through neighbours."""
    count = min(NEIGHBOURS, len(points))
    _, near = Tree(points).neighbours(some, count)
    apart = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
    return np.ascontiguousarray(axes[:, :, 0])
