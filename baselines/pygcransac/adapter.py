"""The authors' Graph-Cut RANSAC through the user's `pygcransac` package."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import rigid_pose
from baselines.contract import Instance
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Uniform samples, local optimisation by graph cuts; the package does not know of time limits."""

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        import pygcransac

        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        low_source, low_target = source.min(axis=0), target.min(axis=0)
        bound = self.inlier_distance(instance)
        # Its grids of neighbours want coordinates from 0.
        pose, _ = pygcransac.findRigidTransform(
            np.ascontiguousarray(np.hstack([source - low_source, target - low_target])),
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
        return None if pose is None else moved_back(np.asarray(pose).T, low_source, low_target)


def moved_back(
    pose: np.ndarray, origin_source: np.ndarray, origin_target: np.ndarray
) -> np.ndarray | None:
    """A pose between clouds measured from these origins, for the clouds as they are."""
    pose = pose.copy()
    pose[:3, 3] += origin_target - pose[:3, :3] @ origin_source
    return rigid_pose(pose)
