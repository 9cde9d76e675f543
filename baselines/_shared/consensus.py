"""Consensus of a pose: the number of source points within a radius of the target."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from baselines._shared.closest_point import ClosestPoint
from baselines.contract import Instance
from dcreg.problem import apply_pose


class Consensus:
    """A problem with both clouds centred at their means; poses refer to this frame."""

    def __init__(self, instance: Instance, radius: float) -> None:
        self.origin_source = instance.source.mean(axis=0)
        self.origin_target = instance.target.mean(axis=0)
        self.source = instance.source - self.origin_source
        self.target = instance.target - self.origin_target
        self.n_inliers, self.radius = instance.n_inliers, radius
        self.tree = cKDTree(self.target)

    def count(self, pose: np.ndarray) -> int:
        """Return the number of moved source points within the radius of a target point."""
        distances, _ = self.tree.query(apply_pose(pose, self.source))
        return int((distances <= self.radius).sum())

    def polish(self, pose: np.ndarray) -> np.ndarray:
        """Refine by trimmed ICP to n_inliers, since many poses share the maximum count."""
        local = ClosestPoint(self.source, self.target, self.n_inliers)
        return local.descend(pose[None], 0.0)[0][0]

    def restore(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose of this frame in the coordinates of the instance."""
        restored = pose.copy()
        restored[:3, 3] += self.origin_target - pose[:3, :3] @ self.origin_source
        return restored
