"""The objective of a problem at a pose, by two evaluators without common code."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from data.library.problem import LibraryError, Problem
from data.library.record import LAST_DIGITS
from dcreg.assignment.objective import objective as compiled_objective
from dcreg.problem import InputError, checked_pose, nearest_rotation, scale_of

FARTHEST = 1e100  # coordinate of a translation whose square does not overflow


def admissible(problem: Problem, given: Any) -> np.ndarray:
    """Return a pose of the model with an exact rotation and a scale in the range.

    Rounding is corrected, because a scale slightly below the range would give a lower objective.

    Raises
    ------
    LibraryError
        If the matrix is not a pose of the model.
    """
    dim, (low, high) = problem.dim, problem.scale_range
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # the scale can be infinite
            pose = checked_pose("pose", given, dim, has_scale=dim == 2)
    except InputError as error:
        raise LibraryError(f"{problem.id}: {error}") from None
    if np.abs(pose[:dim, dim]).max() > FARTHEST:
        raise LibraryError(
            f"{problem.id}: pose: its translation exceeds {FARTHEST:g}, so the objective is not finite; "
            "correct it"
        )
    scale = scale_of(pose) if dim == 2 else 1.0
    if not low * (1 - LAST_DIGITS) <= scale <= high * (1 + LAST_DIGITS):
        raise LibraryError(
            f"{problem.id}: pose: its scale is {scale:.9g}, outside scale_range "
            f"{list(problem.scale_range)}; give an admissible pose"
        )
    pose[:dim, :dim] = np.clip(scale, low, high) * nearest_rotation(pose[:dim, :dim])
    return pose


def evaluate(problem: Problem, pose: np.ndarray) -> float:
    """Return the objective at an admissible pose, on which both evaluators agree.

    Raises
    ------
    LibraryError
        If they do not.
    """
    source, target = problem.clouds
    compiled, _ = compiled_objective(source, target, pose, problem.n_inliers)
    simple = plain_objective(source, target, pose, problem.n_inliers)
    if abs(compiled - simple) > LAST_DIGITS * max(compiled, simple):
        raise LibraryError(
            f"{problem.id}: the evaluators state {compiled!r} and {simple!r}; report this error"
        )
    return simple


def plain_objective(
    source: np.ndarray, target: np.ndarray, pose: np.ndarray, n_inliers: int
) -> float:
    """Return the objective with NumPy and SciPy only: an assignment padded to a square matrix.

    The additional n - k columns and m - k rows take the points without a partner. A high cost prevents
    that they are matched with each other.
    """
    dim = source.shape[1]
    cost = cdist(source @ pose[:dim, :dim].T + pose[:dim, dim], target, "sqeuclidean")
    n, m = cost.shape
    padded = np.zeros((n + m - n_inliers,) * 2)
    padded[:n, :m] = cost
    padded[n:, m:] = (n + m) * (1.0 + cost.max())
    rows, columns = linear_sum_assignment(padded)
    is_pair = (rows < n) & (columns < m)
    return float(padded[rows[is_pair], columns[is_pair]].sum())
