"""A registration problem, checked before anything long starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

ModelName = Literal["similarity2d", "rigid3d"]
# (n, m) mask, or one sequence of target indices per source point
Candidates = np.ndarray | Sequence[Sequence[int]]
MODEL_DIM: dict[str, int] = {"similarity2d": 2, "rigid3d": 3}


class InputError(ValueError):
    """Bad input. The message names the field (and file), the value and the remedy."""


@dataclass(frozen=True)
class Problem:
    """Match `n_inliers` source points one-to-one with target points under a model's best pose.

    Minimise over poses T and one-to-one matchings P of exactly `n_inliers` pairs the sum of squared
    residuals ``sum_ij p_ij |T(x_i) - y_j|^2`` (DC-Reg, arXiv 2603.25442, eq. 1).

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
        Finite points; d is 2 for ``similarity2d`` and 3 for ``rigid3d``.
    n_inliers : int or float
        Number of pairs; a float in (0, 1] is a fraction of ``min(n, m)``.
    model : {"similarity2d", "rigid3d"}
    scale_range : (low, high)
        Admissible scale in 2D. In 3D the scale is 1.
    candidates : (n, m) bool array, or n sequences of target indices, optional
        The feasible pairs; None: all.

    Raises
    ------
    InputError
        Naming the field, the value and the remedy.
    """

    source: np.ndarray
    target: np.ndarray
    n_inliers: int
    model: ModelName
    scale_range: tuple[float, float]
    candidates: np.ndarray | None

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int | float,
        model: str,
        scale_range: tuple[float, float] = (0.5, 1.5),
        candidates: Candidates | None = None,
    ) -> None:
        if model not in MODEL_DIM:
            raise InputError(f"model: {model!r} is unknown; choose one of {sorted(MODEL_DIM)}")
        dim = MODEL_DIM[model]
        source = check_points("source", source, dim, model)
        target = check_points("target", target, dim, model)
        n_inliers = check_n_inliers(n_inliers, min(len(source), len(target)))
        scale_range = (1.0, 1.0) if dim == 3 else check_scale_range(scale_range)
        if candidates is not None:
            candidates = check_candidates(candidates, len(source), len(target), n_inliers)
        for name in ("source", "target", "n_inliers", "model", "scale_range", "candidates"):
            object.__setattr__(self, name, locals()[name])

    @property
    def dim(self) -> int:
        return MODEL_DIM[self.model]


def check_points(name: str, points: np.ndarray, dim: int, model: str) -> np.ndarray:
    """Finite contiguous (n, dim) float64 copy of `points`, or an `InputError`."""
    try:
        points = np.array(points, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not an array of numbers ({error})") from None
    if points.ndim != 2 or points.shape[1] != dim:
        raise InputError(
            f"{name}: shape {points.shape}, but model {model} needs (n, {dim}); "
            f"one point per row, or choose the other model"
        )
    if len(points) == 0:
        raise InputError(f"{name}: no points; give at least one")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(
            f"{name}: {bad.size} point(s) with NaN or infinity, the first in row {bad[0]}: "
            f"{points[bad[0]].tolist()}; remove them"
        )
    return points


def check_n_inliers(n_inliers: int | float, limit: int) -> int:
    """The number of pairs: an integer as it is, a float in (0, 1] as a fraction of `limit`."""
    if isinstance(n_inliers, bool) or not isinstance(n_inliers, int | float | np.number):
        raise InputError(f"n_inliers: {n_inliers!r} is not a number; give a count or a fraction")
    if isinstance(n_inliers, float | np.floating):
        if not 0.0 < n_inliers <= 1.0:
            raise InputError(
                f"n_inliers: the fraction {n_inliers} is outside (0, 1]; "
                f"a count must be an integer between 1 and {limit}"
            )
        # the tiny shift keeps 0.29 * 100 from becoming 28
        return max(1, math.floor(n_inliers * limit + 1e-9))
    if not 1 <= n_inliers <= limit:
        raise InputError(
            f"n_inliers: {n_inliers} pairs cannot be chosen; the smaller cloud has {limit} points, "
            f"so give an integer between 1 and {limit}"
        )
    return int(n_inliers)


def check_candidates(candidates: Candidates, n: int, m: int, n_inliers: int) -> np.ndarray | None:
    """The feasible pairs as an (n, m) mask; None where every pair is feasible.

    Raises
    ------
    InputError
        For a wrong shape, an index outside the target, or pairs that admit no matching of
        `n_inliers`.
    """
    if isinstance(candidates, np.ndarray) and candidates.ndim == 2 and candidates.dtype == bool:
        mask = candidates.copy()
        if mask.shape != (n, m):
            raise InputError(
                f"candidates: mask of shape {mask.shape}; {n} source and {m} target points need "
                f"({n}, {m})"
            )
    else:
        mask = _mask_of_lists(candidates, n, m)
    most = int((maximum_bipartite_matching(csr_array(mask), perm_type="column") >= 0).sum())
    if most < n_inliers:
        raise InputError(
            f"candidates: at most {most} pairs can be matched one to one, fewer than n_inliers = "
            f"{n_inliers}; allow more pairs or lower n_inliers"
        )
    return None if mask.all() else mask


def _mask_of_lists(candidates: Candidates, n: int, m: int) -> np.ndarray:
    try:
        rows = [np.asarray(row, dtype=np.float64).ravel() for row in candidates]
    except (TypeError, ValueError):
        raise InputError(
            "candidates: neither a boolean mask nor one sequence of target indices per source point"
        ) from None
    if len(rows) != n:
        raise InputError(
            f"candidates: {len(rows)} index lists for {n} source points; give one each"
        )
    mask = np.zeros((n, m), dtype=bool)
    for i, row in enumerate(rows):
        bad = row[(row != np.round(row)) | (row < 0) | (row >= m)]
        if bad.size:
            raise InputError(
                f"candidates: {bad[0]:g} for source point {i} is no target index; "
                f"use integers from 0 to {m - 1}"
            )
        mask[i, row.astype(np.int64)] = True
    return mask


def check_scale_range(scale_range: tuple[float, float]) -> tuple[float, float]:
    try:
        low, high = (float(value) for value in scale_range)
    except (TypeError, ValueError):
        raise InputError(f"scale_range: {scale_range!r} is not a pair of numbers") from None
    if not (math.isfinite(low) and math.isfinite(high) and 0.0 < low <= high):
        raise InputError(f"scale_range: ({low}, {high}); it needs 0 < low <= high")
    return low, high


def rms_radius(points: np.ndarray) -> float:
    """Root mean square distance of the points from their centroid.

    0 where they differ by no more than the rounding of their coordinates: that is no unit of length.
    """
    spread = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return spread if spread > 1e-13 * np.abs(points).max() else 0.0


def default_gap_tol(target: np.ndarray, n_inliers: int, tau: float = 0.03) -> float:
    """``n_inliers * (tau * RMS radius of the target)^2``, in squared units of the target.

    A target without extent has no scale to measure a residual by: 0.
    """
    return n_inliers * (tau * rms_radius(np.asarray(target, dtype=np.float64))) ** 2
