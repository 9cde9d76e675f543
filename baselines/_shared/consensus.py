"""Consensus of a pose: the number of source points within a radius of the target, and its ascent."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from baselines._shared.closest_point import ClosestPoint, spread_poses
from baselines.contract import Instance
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

_SHRINK = 0.7  # of the radius between two fits of the ascent


class Consensus:
    """A problem with both clouds centred at their means; poses refer to this frame."""

    def __init__(self, instance: Instance, radius: float) -> None:
        self.origin_source = instance.source.mean(axis=0)
        self.origin_target = instance.target.mean(axis=0)
        self.source = instance.source - self.origin_source
        self.target = instance.target - self.origin_target
        self.n_inliers, self.radius, self.seed = instance.n_inliers, radius, instance.seed
        self.tree = cKDTree(self.target)

    def count(self, pose: np.ndarray) -> int:
        """Return the number of moved source points within the radius of a target point."""
        distances, _ = self.tree.query(apply_pose(pose, self.source))
        return int((distances <= self.radius).sum())

    def ascend(self, pose: np.ndarray, radius: float) -> tuple[np.ndarray, int]:
        """Fit to the pairs within a decreasing radius; return the best pose and its count."""
        best_pose, best = pose, self.count(pose)
        stalled = 0
        while stalled < 2:
            distances, nearest = self.tree.query(apply_pose(pose, self.source))
            near = distances <= radius
            if near.sum() < 3:
                break
            pose = fit_pose(self.source[near], self.target[nearest[near]], (1.0, 1.0))
            count = self.count(pose)
            stalled = 0 if radius > self.radius or count > best else stalled + 1
            if count > best:
                best_pose, best = pose, count
            radius = max(self.radius, _SHRINK * radius)
        return best_pose, best

    def starts(self, count: int, budget: Budget) -> list[tuple[np.ndarray, int]]:
        """Return poses of trimmed ICP from the identity and random rotations, with their counts.

        At least one is returned, and fewer than `count` if the budget is over.
        """
        local = ClosestPoint(self.source, self.target, self.n_inliers)
        spread = spread_poses(count, self.seed, np.zeros(3))
        found = []
        for pose in local.descend_until(spread, 0.0, budget)[0]:
            found.append(self.ascend(pose, 2.0 * self.radius))
            if budget.is_over:
                break
        return found

    def polish(self, pose: np.ndarray) -> np.ndarray:
        """Refine by trimmed ICP to n_inliers, since many poses share the maximum count."""
        local = ClosestPoint(self.source, self.target, self.n_inliers)
        return local.descend(pose[None], 0.0)[0][0]

    def restore(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose of this frame in the coordinates of the instance."""
        restored = pose.copy()
        restored[:3, 3] += self.origin_target - pose[:3, :3] @ self.origin_source
        return restored
