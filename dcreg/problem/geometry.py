"""Poses, sampling, the unit of length, and tolerances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dcreg.problem.trees import tree_of


def scale_of(pose: np.ndarray) -> float:
    """Return the scale of a (d+1, d+1) pose: the d-th root of the absolute determinant."""
    d = len(pose) - 1
    return float(abs(np.linalg.det(pose[:d, :d])) ** (1.0 / d))


def apply_pose(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the (n, d) points moved by a (d+1, d+1) pose."""
    d = len(pose) - 1
    return points @ pose[:d, :d].T + pose[:d, d]


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation (determinant +1) nearest to a (d, d) matrix.

    Removes rounding and scale, and solves Wahba's problem for ``sum target_i source_i^T``.
    """
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    sign = np.ones(len(u))
    sign[-1] = np.sign(np.linalg.det(u @ vt))
    return (u * sign) @ vt


def rotation_angle_deg(rotation: np.ndarray) -> float:
    """Return the angle of a (d, d) rotation in degrees: signed in 2D, about the axis in 3D.

    The arc tangent of sine and cosine is accurate near 0 and 180 degrees, where the arc cosine is not.
    """
    if len(rotation) == 2:
        return math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))
    skew = rotation - rotation.T
    sine = math.sqrt(skew[0, 1] ** 2 + skew[0, 2] ** 2 + skew[1, 2] ** 2) / 2
    return math.degrees(math.atan2(sine, (np.trace(rotation) - 1) / 2))


def angle_between_deg(T: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between the rotations of two (d+1, d+1) poses in degrees, at least 0."""
    return abs(rotation_angle_deg(nearest_rotation(T[:-1, :-1] @ other[:-1, :-1].T)))


def rotation_axis(T: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the unit axis of the rotation from the (4, 4) pose `other` to `T`, in the target."""
    turn = nearest_rotation(T[:-1, :-1] @ other[:-1, :-1].T)
    axis = np.linalg.eigh(turn + turn.T)[1][:, -1]  # also for half turns
    towards = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    along = float(axis @ towards) or float(axis[np.argmax(np.abs(axis))])
    return axis * np.sign(along)


class Moments(NamedTuple):
    """Mean and covariance of points, from which the displacement between two poses follows."""

    mean: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> Moments:
        d = points.shape[1]
        return cls(points.mean(axis=0), np.cov(points, rowvar=False, bias=True).reshape(d, d))

    def displacements(self, linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the RMS length of L x + t over the points, for (B, d, d) L and (B, d) t."""
        means = ((linear @ self.mean + shift) ** 2).sum(axis=1)
        spreads = np.einsum("bij,jk,bik->b", linear, self.covariance, linear)
        return np.asarray(np.sqrt(np.maximum(means + spreads, 0.0)))  # rounding can be negative

    def displacement(self, T: np.ndarray, other: np.ndarray) -> float:
        """Return the RMS displacement of the points between two (d+1, d+1) poses."""
        difference = (T - other)[None]
        return float(self.displacements(difference[:, :-1, :-1], difference[:, :-1, -1])[0])


_LOOKED_AT = 5000  # points, for the median distance to the next one
_FEW_POINTS = 1000  # whose distances are compared one by one, without loading SciPy
_NEIGHBOURS = 3
_ISOLATED = 6.0  # times the median distance to the third neighbour
# Clutter has few points around it, and they fill a volume; those of a thin part of a surface do not.
_AROUND = 12  # neighbours that show a volume
_DENSITY = 8  # the neighbour whose distance shows the density
_SPARSE = 2.0  # times the median distance to that neighbour
_THINNED, _THINNED_TIMES = 40_000, 10  # points, or times the sample, of which a sample is drawn
_MAX_DISTANCES = 500_000_000  # compared to choose farthest points, which takes seconds
_VOLUME = 0.08  # least ratio of the smallest to the largest variance of the neighbours


def median_spacing(points: np.ndarray, max_queries: int = _LOOKED_AT) -> float:
    """Return the median nearest-neighbour distance of up to `max_queries` points; 0 for one point."""
    if len(points) < 2:
        return 0.0
    some = points[:: -(-len(points) // max_queries)]
    return float(np.median(_second_nearest(points, some)))


def _second_nearest(points: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Return the distance of each of `some` points to the second nearest point."""
    if len(points) > _FEW_POINTS:
        return np.asarray(tree_of(points).neighbours(some, 2)[0][:, 1])
    squared = np.zeros((len(some), len(points)))
    for axis in range(points.shape[1]):
        squared += np.subtract.outer(some[:, axis], points[:, axis]) ** 2
    return np.sqrt(np.partition(squared, 1, axis=1)[:, 1])


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return the rows of `count` points by farthest-point sampling.

    Each point is as far as possible from those before it. The first is the point nearest to the
    centroid. Except for ties the choice does not depend on the order of the points.

    Parameters
    ----------
    points : (n, d) array
    count : int

    Returns
    -------
    (min(count, n),) int array
        Ascending; all rows if there are at most `count`.
    """
    if count >= len(points):
        return np.arange(len(points))
    first = int(np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
    return np.unique(farthest_point_order(points, count, first))


def farthest_point_order(points: np.ndarray, count: int, first: int) -> np.ndarray:
    """Return the rows of `count` points in the order of farthest-point sampling from row `first`.

    Ties go to the lower row.
    """
    chosen = np.empty(count, np.int64)
    chosen[0] = first
    axes = np.ascontiguousarray(points.T)  # summing axis by axis takes a sixth of the time
    nearest = np.full(len(points), np.inf)
    for at in range(1, count):
        gaps = axes - axes[:, chosen[at - 1], None]
        np.minimum(nearest, (gaps * gaps).sum(axis=0), out=nearest)
        chosen[at] = np.argmax(nearest)
    return chosen


def isolated(points: np.ndarray) -> np.ndarray:
    """Return a mask of the outliers; always fewer than half of the points.

    They are far from all others, or have few points around them, which fill a volume: clutter.
    Farthest-point sampling would select them first.

    Parameters
    ----------
    points : (n, d) array

    Returns
    -------
    (n,) bool array
    """
    if len(points) <= _NEIGHBOURS:
        return np.zeros(len(points), dtype=bool)
    count = min(_AROUND, len(points) - 1)
    reach, nearest = tree_of(points).neighbours(points, count + 1)
    usual = np.median(reach[:, _NEIGHBOURS])
    far = np.asarray((reach[:, _NEIGHBOURS] > _ISOLATED * usual) & (usual > 0.0))
    if count < _AROUND:
        return far
    distance, usual = reach[:, _DENSITY], np.median(reach[:, _DENSITY])
    sparse = np.flatnonzero((distance > _SPARSE * usual) & (usual > 0.0))
    around = points[nearest[sparse]]
    around -= around.mean(axis=1, keepdims=True)
    variances = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", around, around))
    clutter = far.copy()
    clutter[sparse] |= variances[:, 0] > _VOLUME * variances[:, -1]
    return clutter if 2 * clutter.sum() < len(points) else far


def sampled_pairs(
    n_inliers: int, clouds: Sequence[np.ndarray], samples: Sequence[np.ndarray]
) -> int:
    """Return how many pairs samples of two clouds can have, at least one.

    A point of the cloud of which the smaller share is taken has a partner in the other sample if it has
    one at all, or nearly so; the others have none to take.
    """
    shares = (len(few) / len(all_) for few, all_ in zip(samples, clouds, strict=True))
    return max(1, round(min(shares) * n_inliers))


def representative_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return the rows of `count` farthest points among those that are not `isolated`.

    Many points are thinned at random first: the ratios of distances, which show outliers, stay the same.
    A sample so large that its farthest points would take minutes is drawn at random, without outliers.

    Parameters
    ----------
    points : (n, d) array
    count : int

    Returns
    -------
    (C,) int array
        Ascending. C is less than `count` only if fewer points remain; all rows if n is at most `count`.
    """
    if count >= len(points):
        return np.arange(len(points))
    some = np.arange(len(points))
    if len(points) > max(_THINNED, _THINNED_TIMES * count):
        rng = np.random.default_rng(0)
        some = np.sort(rng.permutation(len(points))[: max(_THINNED, _THINNED_TIMES * count)])
    kept = some[~isolated(points[some])]
    if count * len(kept) > _MAX_DISTANCES:
        return np.sort(np.random.default_rng(0).permutation(kept)[:count])
    return kept[farthest_points(points[kept], count)]


_ROUNDING = 1e-14  # rounding error of a squared residual, in squared RMS radii of the target
EXACT = 100.0  # a fit is exact if its objective is at most this many rounding errors
# RMS radius divided by typical radius, above which few points are far from all others.
TYPICAL = 3.0


def rms_radius(points: np.ndarray) -> float:
    """Return the root mean square distance of the points from their centroid.

    0 where they differ by no more than the rounding of their coordinates: that is no unit of length.
    """
    spread = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return spread if spread > 1e-13 * np.abs(points).max() else 0.0


def unit_length(source: np.ndarray, target: np.ndarray) -> float:
    """Return the RMS radius of the target, of the source if the target has no extent, else 0."""
    return rms_radius(target) or rms_radius(source)


def rounding_error(source: np.ndarray, target: np.ndarray, n_inliers: int) -> float:
    """Return the rounding error of the objective of `n_inliers` pairs, an upper estimate.

    Of each pair: the square of 1e-7 RMS radii of the target, plus that of a few last bits of the
    coordinates.
    """
    return _rounding(source, target, n_inliers, unit_length(source, target))


def exact_objective(source: np.ndarray, target: np.ndarray, n_inliers: int) -> float:
    """Return the objective up to which a fit of `n_inliers` pairs counts as exact.

    `EXACT` rounding errors, of a unit of length that few far points do not change: a fit is not exact
    because one point is far from all others.
    """
    unit = min(unit_length(source, target), TYPICAL * (typical_radius(target) or np.inf))
    return EXACT * _rounding(source, target, n_inliers, unit)


def last_bits(source: np.ndarray, target: np.ndarray) -> float:
    """Return the rounding error of a residual: a few last bits of the coordinates."""
    return 16.0 * float(np.finfo(float).eps * max(np.abs(source).max(), np.abs(target).max()))


def error_of_sum(value: float, n_pairs: int, bits: float) -> float:
    """Return the error of a sum of squares if each residual may be wrong by `bits`."""
    return 2.0 * math.sqrt(n_pairs * value) * bits + n_pairs * bits**2


def typical_radius(points: np.ndarray) -> float:
    """Return the median distance of the points from their coordinate-wise median."""
    return float(np.sqrt(np.median(((points - np.median(points, axis=0)) ** 2).sum(axis=1))))


def _rounding(source: np.ndarray, target: np.ndarray, n_inliers: int, unit: float) -> float:
    return n_inliers * (_ROUNDING * (unit or 1.0) ** 2 + last_bits(source, target) ** 2)


def fit_pose(
    source: np.ndarray,
    target: np.ndarray,
    scale_range: tuple[float, float],
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """Return the least-squares pose of paired points (Umeyama 1991), with clipped scale.

    The rotation is proper (determinant +1) also for mirrored or degenerate data. It is the best one for
    every scale, and the cost a convex parabola in the scale: clipping gives the constrained optimum.

    Parameters
    ----------
    source, target : (..., k, d) arrays
        Leading axes hold further problems, fitted side by side.
    scale_range : (low, high)
        Of points that all coincide any scale is as good; they get `low`.
    weights : (..., k) array, optional
        Of the squared residuals, not all zero; default: equal.

    Returns
    -------
    (..., d+1, d+1) array
    """
    d = source.shape[-1]
    if weights is None:
        mean_x, mean_y = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
        x, y = source - mean_x, target - mean_y
        weighted_x = x
    else:
        shares = (weights / weights.sum(axis=-1, keepdims=True))[..., None, :]
        mean_x, mean_y = shares @ source, shares @ target
        x, y = source - mean_x, target - mean_y
        weighted_x = np.swapaxes(shares, -1, -2) * x
    u, singular, vt = np.linalg.svd(np.swapaxes(y, -1, -2) @ weighted_x)
    sign = np.ones_like(singular)
    sign[..., -1] = np.where(np.linalg.det(u) * np.linalg.det(vt) > 0, 1.0, -1.0)
    rotation = (u * sign[..., None, :]) @ vt
    spread = (weighted_x * x).sum(axis=(-2, -1))
    low, high = scale_range
    gain = (singular * sign).sum(axis=-1)
    scale = np.clip(gain / np.where(spread > 0, spread, np.inf), low, high)
    T = np.zeros((*singular.shape[:-1], d + 1, d + 1))
    T[..., :d, :d] = scale[..., None, None] * rotation
    T[..., :d, d] = (mean_y - mean_x @ np.swapaxes(T[..., :d, :d], -1, -2))[..., 0, :]
    T[..., d, d] = 1.0
    return T
