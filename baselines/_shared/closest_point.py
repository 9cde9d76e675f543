"""Trimmed rigid ICP, the local refinement of the nearest-neighbour searches."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from baselines._shared.poses import homogeneous
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

_AT_ONCE = 16  # poses refined between two checks of the budget


class ClosestPoint:
    """Minimise the sum of the `n_kept` smallest squared distances to the target, locally."""

    def __init__(self, source: np.ndarray, target: np.ndarray, n_kept: int) -> None:
        self.source, self.target, self.n_kept = source, target, n_kept
        self.tree = cKDTree(target)

    def value(self, pose: np.ndarray) -> float:
        """Return the objective at a pose, by exact nearest neighbours."""
        distances, _ = self.tree.query(apply_pose(pose, self.source))
        return float((np.sort(distances)[: self.n_kept] ** 2).sum())

    def descend(
        self, poses: np.ndarray, tolerance: float, max_iterations: int = 100
    ) -> tuple[np.ndarray, np.ndarray]:
        """Refine (b, 4, 4) poses together; return poses that are no worse, and their values."""
        best_poses, best = poses.copy(), np.full(len(poses), np.inf)
        active = np.arange(len(poses))
        for _ in range(max_iterations):
            moved = self.source @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
            distances, nearest = self.tree.query(moved)
            kept = np.argsort(distances, axis=1, kind="stable")[:, : self.n_kept]
            values = (np.take_along_axis(distances, kept, axis=1) ** 2).sum(axis=1)
            gained = best[active] - values
            better = gained > 0.0
            best_poses[active[better]], best[active[better]] = poses[better], values[better]
            going = gained > tolerance
            if not going.any():
                break
            active, kept = active[going], kept[going]
            partners = self.target[np.take_along_axis(nearest[going], kept, axis=1)]
            poses = fit_pose(self.source[kept], partners, (1.0, 1.0))
        return best_poses, best

    def descend_until(
        self, poses: np.ndarray, tolerance: float, budget: Budget
    ) -> tuple[np.ndarray, np.ndarray]:
        """Call `descend` with a few poses at a time until all are refined or the budget is over."""
        done = []
        for first in range(0, len(poses), _AT_ONCE):
            done.append(self.descend(poses[first : first + _AT_ONCE], tolerance))
            if budget.is_over:
                break
        descended, values = zip(*done, strict=True)
        return np.concatenate(descended), np.concatenate(values)


def spread_poses(count: int, seed: int, translation: np.ndarray) -> np.ndarray:
    """Return the identity and `count` - 1 random rotations, all with the same translation."""
    drawn = Rotation.random(max(count - 1, 1), random_state=np.random.default_rng(seed))
    rotations = [np.eye(3), *drawn.as_matrix()[: count - 1]]
    return np.array([homogeneous(1.0, rotation, translation) for rotation in rotations])
