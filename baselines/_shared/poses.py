"""Poses as homogeneous matrices, and lengths used by several adapters."""

from __future__ import annotations

import numpy as np

from baselines.contract import Instance
from dcreg import problem
from dcreg.problem import nearest_rotation, unit_length


def homogeneous(scale: float, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return ``p -> scale * rotation @ p + translation`` as a (d+1, d+1) matrix."""
    d = len(translation)
    pose = np.eye(d + 1)
    pose[:d, :d] = scale * np.asarray(rotation)
    pose[:d, d] = translation
    return pose


def rigid_pose(pose: np.ndarray) -> np.ndarray | None:
    """Return the pose with a proper rotation and scale 1; None if it has non-finite entries."""
    pose = np.asarray(pose, dtype=float)
    if not np.isfinite(pose).all():
        return None
    d = len(pose) - 1
    return homogeneous(1.0, nearest_rotation(pose[:d, :d]), pose[:d, d])


def unit_of(instance: Instance) -> float:
    """Return the library's unit of length for scaling clouds; 1 if no cloud has an extent."""
    return unit_length(instance.source, instance.target) or 1.0


def median_spacing(points: np.ndarray) -> float:
    """Median distance of a point to its nearest neighbour, without duplicates; 1 for a single point."""
    distinct = np.unique(points, axis=0)
    return problem.median_spacing(distinct, len(distinct)) or 1.0
