"""The authors' Graph-Cut RANSAC through the user's `pygcransac` package."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import rigid_pose
from baselines.contract import Instance
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Uniform samples, local optimisation by graph cuts. The package has no time limit."""

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        import pygcransac

        bound = self.inlier_distance(instance)
        rows, *origins = from_zero(instance, pairs)  # as its neighbourhood grids require
        found, _ = pygcransac.findRigidTransform(
            rows,
            probabilities=[],
            threshold=bound,
            conf=self.options["confidence"],
            spatial_coherence_weight=self.options["spatial_coherence_weight"],
            max_iters=self.options["max_samples"],
            use_sprt=False,
            sampler=0,
            neighborhood=0,
            neighborhood_size=self.options["neighbourhood"] * bound,
        )
        return moved_back(found, *origins)


def from_zero(instance: Instance, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs as (N, 6) rows of non-negative coordinates, and the origins of source and target."""
    source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
    low_source, low_target = source.min(axis=0), target.min(axis=0)
    return np.hstack([source - low_source, target - low_target]), low_source, low_target


def moved_back(
    found: np.ndarray | None, origin_source: np.ndarray, origin_target: np.ndarray
) -> np.ndarray | None:
    """Convert a pose for row vectors relative to these origins to the pose of the clouds."""
    if found is None:
        return None
    pose = np.array(found).T
    pose[:3, 3] += origin_target - pose[:3, :3] @ origin_source
    return rigid_pose(pose)
