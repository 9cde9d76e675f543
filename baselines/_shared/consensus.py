"""Poses by consensus: how many source points come within a radius of the target, and ascent of it."""

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
    """One problem with both clouds centred on their means; poses are of that frame."""

    def __init__(self, instance: Instance, radius: float) -> None:
        self.origin_source = instance.source.mean(axis=0)
        self.origin_target = instance.target.mean(axis=0)
        self.source = instance.source - self.origin_source
        self.target = instance.target - self.origin_target
        self.n_inliers, self.radius, self.seed = instance.n_inliers, radius, instance.seed
        self.tree = cKDTree(self.target)

    def count(self, pose: np.ndarray) -> int:
        """Source points that the pose brings within the radius of a target point."""
        distances, _ = self.tree.query(apply_pose(pose, self.source))
        return int((distances <= self.radius).sum())

    def ascend(self, pose: np.ndarray, radius: float) -> tuple[np.ndarray, int]:
        """Fits to the pairs within a shrinking radius; the best pose met and its count."""
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
        """Poses of trimmed ICP from the identity and random rotations, with their counts.

        At least one; fewer than `count` where the budget was over first.
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
        """Trimmed ICP to n_inliers: many poses share the largest count, this one fits best."""
        local = ClosestPoint(self.source, self.target, self.n_inliers)
        return local.descend(pose[None], 0.0)[0][0]

    def restore(self, pose: np.ndarray) -> np.ndarray:
        """A pose of this frame in the coordinates of the instance."""
        restored = pose.copy()
        restored[:3, 3] += self.origin_target - pose[:3, :3] @ self.origin_source
        return restored
