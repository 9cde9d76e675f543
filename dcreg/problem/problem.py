"""A registration problem: clouds, number of pairs, model and feasible pairs, all checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from dcreg.names import MODEL_DIM
from dcreg.problem.errors import InputError, suggestion
from dcreg.problem.geometry import fit_pose
from dcreg.problem.pose_range import PoseRange
from dcreg.problem.weights import PairWeights, PointWeights, check_costs

if TYPE_CHECKING:
    from dcreg.problem.attributes import Attributes

# (n, m) mask, or one sequence of target indices per source point
Candidates = np.ndarray | Sequence[Sequence[int]]


def check_candidates(candidates: Candidates, n: int, m: int, n_inliers: int) -> np.ndarray | None:
    """Return the feasible pairs as an (n, m) mask; None if every pair is feasible.

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
    most = _matching_size(mask)
    if most < n_inliers:
        raise InputError(
            f"candidates: at most {most} pairs can be matched one to one, fewer than n_inliers = "
            f"{n_inliers}; allow more pairs or lower n_inliers"
        )
    return None if mask.all() else mask


def _matching_size(mask: np.ndarray) -> int:
    return int((largest_matching(mask) >= 0).sum())


def largest_matching(mask: np.ndarray) -> np.ndarray:
    """Return the column matched to every row (-1: none) in a largest matching over feasible pairs."""
    # loaded here: most problems have no infeasible pairs
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    matched: np.ndarray = maximum_bipartite_matching(csr_array(mask), perm_type="column")
    return matched


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
                f"candidates: {bad[0]:g} for source point {i} is not a target index; "
                f"use integers from 0 to {m - 1}"
            )
        mask[i, row.astype(np.int64)] = True
    return mask


_FIELDS = (
    "source", "target", "n_inliers", "model", "scale_range", "candidates", "pose_range",
)  # fmt: skip
ModelName = Literal["similarity2d", "rigid3d", "similarity3d"]
LARGEST_COORDINATE = 1e100  # its square, times any number of points, is far from overflow
LARGEST_SCALE = 1e6  # beyond it, or below its inverse, the clouds share no digits
DEFAULT_SCALE_RANGE = {
    "similarity2d": (0.5, 1.5), "rigid3d": (1.0, 1.0), "similarity3d": (0.5, 1.5),
}  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """Match `n_inliers` source points one-to-one with target points under the best pose of a model.

    Minimise over poses T and one-to-one matchings P of exactly `n_inliers` pairs the sum of squared
    residuals ``sum_ij p_ij |T(x_i) - y_j|^2`` (DC-Reg, arXiv 2603.25442, eq. 1).

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
        Finite points; d is 2 for ``similarity2d``, and 3 for ``rigid3d`` and ``similarity3d``.
    n_inliers : int or float
        Number of pairs; a float in (0, 1] is a fraction of ``min(n, m)``.
    model : {"similarity2d", "rigid3d", "similarity3d"}
    scale_range : (low, high), optional
        Admissible scale, default (0.5, 1.5); equal numbers fix it. The scale of ``rigid3d`` is 1.
    candidates : (n, m) bool array, or n sequences of target indices, optional
        The feasible pairs; None: all.
    pose_range : PoseRange, optional
        The admissible poses; None: all of the model.
    weights : PointWeights, optional
        Weights of the points; kept as the costs of weighted pairs, or as None if all are equal.
        `with_attributes` adds the costs of attributes.

    Raises
    ------
    InputError
        The message names the field and the value, and says what to do.
    """

    source: np.ndarray
    target: np.ndarray
    n_inliers: int
    model: ModelName
    scale_range: tuple[float, float]
    candidates: np.ndarray | None
    pose_range: PoseRange | None
    weights: PairWeights | None

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int | float,
        model: str,
        scale_range: tuple[float, float] | None = None,
        candidates: Candidates | None = None,
        pose_range: PoseRange | None = None,
        weights: PointWeights | None = None,
    ) -> None:
        if model not in [*MODEL_DIM]:  # it may be unhashable
            raise InputError(f"model: {model!r} is unknown{suggestion(model, MODEL_DIM)}")
        dim = MODEL_DIM[model]
        source = check_points("source", source, dim, model)
        target = check_points("target", target, dim, model)
        n_inliers = check_n_inliers(n_inliers, min(len(source), len(target)))
        scale_range = check_scale_range(scale_range, model)
        if candidates is not None:
            candidates = check_candidates(candidates, len(source), len(target), n_inliers)
        if pose_range is not None:
            if not isinstance(pose_range, PoseRange):
                raise InputError(
                    f"pose_range: {pose_range!r} is not a PoseRange; give one such as "
                    "dcreg.PoseRange(max_angle=30)"
                )
            if model == "similarity3d":
                raise InputError(
                    "pose_range: not supported by similarity3d; omit pose_range, or rescale one cloud "
                    "and use model rigid3d"
                )
            pose_range = pose_range.checked(source, scale_range)
        if not isinstance(weights, PointWeights | None):
            raise InputError(
                f"weights: {weights!r} is not a PointWeights; give one such as "
                "dcreg.PointWeights(source=confidences)"
            )
        for name in _FIELDS:
            object.__setattr__(self, name, locals()[name])
        sizes = len(source), len(target), n_inliers
        object.__setattr__(self, "weights", None if weights is None else weights.of_pairs(*sizes))

    @property
    def dim(self) -> int:
        """Dimension of the points: 2 or 3."""
        return MODEL_DIM[self.model]

    @property
    def max_n_inliers(self) -> int:
        """The largest number of pairs that can be matched one to one."""
        if self.candidates is not None:
            return _matching_size(self.candidates)
        return min(len(self.source), len(self.target))

    @property
    def has_scale(self) -> bool:
        """Whether the poses of the model have a scale, which may be fixed."""
        return self.model != "rigid3d"

    def fit(
        self, source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the least-squares pose of paired (k, d) points; see `PoseRange.fit` for a range."""
        if self.pose_range is None:
            return fit_pose(source, target, self.scale_range, weights)
        return self.pose_range.fit(source, target, self.scale_range)

    def with_n_inliers(self, n_inliers: int | float) -> Problem:
        """Return the problem over the same clouds for another number of pairs.

        Raises
        ------
        InputError
            If the number is out of range, or the feasible pairs do not allow it.
        """
        count = check_n_inliers(n_inliers, min(len(self.source), len(self.target)))
        if self.candidates is not None and count > self.n_inliers:
            check_candidates(self.candidates, len(self.source), len(self.target), count)
        other = copy(self)
        object.__setattr__(other, "n_inliers", count)
        return other

    def with_attributes(self, attributes: Attributes | None) -> Problem:
        """Return the problem whose costs of pairs include those of attributes.

        Raises
        ------
        InputError
        """
        if attributes is None:
            return self
        from dcreg.problem.attributes import Attributes  # few problems have them

        if not isinstance(attributes, Attributes):
            raise InputError(
                f"attributes: {type(attributes).__name__} is not an Attributes; give one such as "
                "dcreg.Attributes(source_colours, target_colours, scale=0.1)"
            )
        n, m = len(self.source), len(self.target)
        check_costs("attributes", n, m)
        costs = attributes.costs(n, m, float(np.ptp(self.target, axis=0).max()))
        if not costs.any():
            return self
        weights = self.weights or PairWeights(np.ones((n, m)), np.zeros((n, m)))
        other = copy(self)
        object.__setattr__(other, "weights", weights.with_attributes(costs))
        return other


def check_points(name: str, points: np.ndarray, dim: int, model: str) -> np.ndarray:
    """Return a finite contiguous (n, dim) float64 copy of `points`, or raise `InputError`."""
    try:
        if np.ma.is_masked(points) or np.iscomplexobj(points):
            raise TypeError("masked or complex entries")
        points = np.array(points, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not an array of real numbers ({error})") from None
    if points.ndim != 2 or points.shape[1] != dim:
        raise InputError(
            f"{name}: shape {points.shape}, but model {model} needs (n, {dim}); "
            f"give one point per row, or choose another model"
        )
    if len(points) == 0:
        raise InputError(f"{name}: no points; give at least one")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(
            f"{name}: {bad.size} point(s) with NaN or infinity, the first in row {bad[0]}: "
            f"{points[bad[0]].tolist()}; remove them"
        )
    if np.abs(points).max() > LARGEST_COORDINATE:
        row = int(np.abs(points).max(axis=1).argmax())
        raise InputError(
            f"{name}: {points[row].tolist()} in row {row} is too large, its squared distances would "
            f"overflow; give both clouds in a larger unit, so that coordinates are below "
            f"{LARGEST_COORDINATE:g}"
        )
    extent = np.ptp(points, axis=0).max()
    if 0.0 < extent < 1.0 / LARGEST_COORDINATE:
        raise InputError(
            f"{name}: the extent {extent:.3g} is too small, its squared distances would underflow; "
            f"give both clouds in a smaller unit, so that it is above {1.0 / LARGEST_COORDINATE:g}"
        )
    return points


def check_n_inliers(n_inliers: int | float, limit: int) -> int:
    """Return the number of pairs; a float in (0, 1] is a fraction of `limit`."""
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
            f"n_inliers: {n_inliers} pairs cannot be matched, as the smaller cloud has {limit} points; "
            f"give an integer between 1 and {limit}"
        )
    return int(n_inliers)


def check_scale_range(scale_range: tuple[float, float] | None, model: str) -> tuple[float, float]:
    """Return the admissible scales, by default those of the model."""
    if scale_range is None:
        return DEFAULT_SCALE_RANGE[model]
    try:
        if any(isinstance(value, str) for value in scale_range):
            raise TypeError
        low, high = map(float, scale_range)
    except (TypeError, ValueError):
        raise InputError(
            f"scale_range: {scale_range!r} is not a pair of numbers; give (low, high)"
        ) from None
    if not (math.isfinite(low) and math.isfinite(high) and 0.0 < low <= high):
        raise InputError(f"scale_range: ({low}, {high}) is invalid; it needs 0 < low <= high")
    if low < 1.0 / LARGEST_SCALE or high > LARGEST_SCALE:
        raise InputError(
            f"scale_range: ({low}, {high}) exceeds the range {1.0 / LARGEST_SCALE:g} to "
            f"{LARGEST_SCALE:g}; rescale one cloud first, so that the scale is near 1"
        )
    if model == "rigid3d" and (low, high) != (1.0, 1.0):
        raise InputError(
            f"scale_range: ({low}, {high}), but rigid3d has no scale; use model similarity3d, or leave "
            "it out, and rescale one cloud first if their units differ"
        )
    return low, high
