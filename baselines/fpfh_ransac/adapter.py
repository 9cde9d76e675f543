"""RANSAC on FPFH correspondences, Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines._shared import open3d_clouds
from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import rigid_pose
from baselines.contract import Instance
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Samples of three pairs; the pose with the most pairs within the inlier distance.

    Its own front end is Open3D's recipe: features and threshold follow from a voxel size.
    """

    has_own_front_end = True

    def solve_clouds(self, instance: Instance) -> tuple[np.ndarray | None, int]:
        import open3d

        open3d.utility.random.seed(instance.seed % 2**31)
        registration = open3d.pipelines.registration
        voxel = self.inlier_distance(instance)
        (source, of_source), (target, of_target) = (
            open3d_clouds.downsampled(points, voxel)
            for points in (instance.source, instance.target)
        )
        outcome = registration.registration_ransac_based_on_feature_matching(
            source, target, of_source, of_target, True, 1.5 * voxel,
            registration.TransformationEstimationPointToPoint(False), 3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
            ],
            self._criteria(),
        )  # fmt: skip
        n_pairs = len(outcome.correspondence_set)
        return (rigid_pose(outcome.transformation) if n_pairs >= 3 else None), n_pairs

    def _criteria(self) -> Any:
        import open3d

        return open3d.pipelines.registration.RANSACConvergenceCriteria(
            self.options["max_iterations"], self.options["confidence"]
        )

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
            criteria=self._criteria(),
        )
        found = len(outcome.correspondence_set) >= instance.dim
        return rigid_pose(outcome.transformation) if found else None
