"""Reduce a pair of scans with a known pose to an instance of a few hundred points."""

from __future__ import annotations

import numpy as np

from data.contract import RawInstance
from data.sampling import farthest_points, mutual_nearest, voxel_downsample
from dcreg.problem import apply_pose


def scan_instance(
    source: np.ndarray,
    target: np.ndarray,
    T_true: np.ndarray,
    *,
    voxel: float,
    n_points: int,
    tolerance: float,
    info: dict[str, float | str],
) -> RawInstance:
    """Downsample each scan separately: voxel grid, then farthest-point sampling.

    The two samples share no physical points. ``pairs`` are mutual nearest neighbours under `T_true` at
    most `tolerance` apart. They have residuals up to `tolerance` even at the true pose, and their number
    depends on `n_points`.
    """
    few = [_sample(cloud, voxel, n_points) for cloud in (source, target)]
    pairs = mutual_nearest(apply_pose(T_true, few[0]), few[1], tolerance)
    return RawInstance(few[0], few[1], pairs, T_true, (1.0, 1.0), info)


def _sample(cloud: np.ndarray, voxel: float, n_points: int) -> np.ndarray:
    coarse = voxel_downsample(np.asarray(cloud, dtype=float), voxel)
    return coarse[farthest_points(coarse, min(n_points, len(coarse)))]
