"""RANSAC on FPFH correspondences, Open3D."""

from __future__ import annotations

import numpy as np

from baselines._shared import open3d_clouds
from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import rigid_pose
from baselines.contract import Instance
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Samples of three pairs; the pose with the most pairs within the inlier distance."""

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        import open3d

        # Open3D respects the seed only in part, hence `deterministic: false` in the card.
        open3d.utility.random.seed(instance.seed % 2**31)
        registration = open3d.pipelines.registration
        outcome = registration.registration_ransac_based_on_correspondence(
            open3d_clouds.cloud(instance.source),
            open3d_clouds.cloud(instance.target),
            open3d.utility.Vector2iVector(pairs.astype(np.int32)),
            self.inlier_distance(instance),
            ransac_n=3,
            checkers=[registration.CorrespondenceCheckerBasedOnEdgeLength(0.9)],
            criteria=registration.RANSACConvergenceCriteria(
                self.options["max_iterations"], self.options["confidence"]
            ),
        )
        found = len(outcome.correspondence_set) >= instance.dim
        return rigid_pose(outcome.transformation) if found else None
