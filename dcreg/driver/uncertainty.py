"""What a result says about its pose (covariance, open directions) and its number of pairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dcreg.problem import PoseRange, apply_pose, open_directions, pose_covariance
from dcreg.result import Result
from dcreg.result_parts import ProvenNumber

_BELOW = 1.0 - 1e-9  # factor for a distance strictly below a proven one


def with_uncertainty(
    result: Result,
    source: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray | None = None,
    *,
    has_scale: bool = False,
    surface: np.ndarray | None = None,
    pose_range: PoseRange | None = None,
) -> Result:
    """Return the result with the covariance of its pose, and the directions that the clouds leave open.

    Parameters
    ----------
    result : Result
    source, target : (n, d), (m, d) arrays
    weights : (n_inliers,) array, optional
        Of the pairs.
    has_scale : bool
        Whether the scale was free.
    surface : (k, d) array, optional
        Source points at the pose that are moved to find open directions; default: the matched ones.
    pose_range : PoseRange, optional
        The covariance is that of its free directions; open directions are those of all poses, and are
        not tested.
    """
    pose, (rows, columns) = result.T_target_source, result.assignment.T
    matched = source[rows]
    moved = apply_pose(pose, matched) if surface is None else surface
    covariance = pose_covariance(
        pose, matched, target[columns], weights, has_scale=has_scale, pose_range=pose_range
    )
    slides = None
    if pose_range is None:
        slides = open_directions(moved, target, has_scale=has_scale)
    return replace(result, covariance=covariance, open_directions=slides)


def proven_number(result: Result, source: np.ndarray, target: np.ndarray) -> ProvenNumber | None:
    """Return what the lower bound L of a result without weights says about the number of pairs.

    k pairs within d have a sum of squares of at most k d^2. So below sqrt(L / k) there are fewer.
    """
    k = result.n_inliers
    if result.downsampled is not None or result.lower_bound <= 0.0:
        return None
    distance = float(np.sqrt(result.lower_bound / k)) * _BELOW
    rows, columns = result.assignment.T
    gaps = apply_pose(result.T_target_source, source[rows]) - target[columns]
    return ProvenNumber(distance, int((np.linalg.norm(gaps, axis=1) <= distance).sum()), k - 1)
