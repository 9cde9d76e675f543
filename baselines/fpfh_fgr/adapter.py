"""Fast global registration on FPFH correspondences, Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines._shared import open3d_clouds
from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import rigid_pose
from baselines.contract import Instance
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Graduated non-convexity with line processes over the pairs that pass the tuple test.

    Its own front end is Open3D's recipe: features and threshold follow from a voxel size.
    """

    has_own_front_end = True

    def solve_clouds(self, instance: Instance) -> tuple[np.ndarray | None, int]:
        import open3d

        open3d.utility.random.seed(instance.seed % 2**31)
        voxel = self.inlier_distance(instance)
        (source, of_source), (target, of_target) = (
            open3d_clouds.downsampled(points, voxel)
            for points in (instance.source, instance.target)
        )
        outcome = open3d.pipelines.registration.registration_fgr_based_on_feature_matching(
            source, target, of_source, of_target, self._settings(0.5 * voxel, absolute=False)
        )
        return _moved(outcome), len(outcome.correspondence_set)

    def _settings(self, distance: float, absolute: bool = True) -> Any:
        import open3d

        return open3d.pipelines.registration.FastGlobalRegistrationOption(
            # With the absolute scale, lengths are in target units; the recipe keeps the default.
            use_absolute_scale=absolute,
            decrease_mu=True,
            maximum_correspondence_distance=distance,
            iteration_number=self.options["max_iterations"],
            maximum_tuple_count=self.options["max_tuples"],
            tuple_test=self.options["tuple_test"],
        )

    def idle_options(self) -> dict[str, str]:
        idle = super().idle_options()
        if not self.options["tuple_test"]:
            idle["max_tuples"] = "without the tuple_test"
        return idle

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        import open3d

        open3d.utility.random.seed(instance.seed % 2**31)
        registration = open3d.pipelines.registration
        outcome = registration.registration_fgr_based_on_correspondence(
            open3d_clouds.cloud(instance.source),
            open3d_clouds.cloud(instance.target),
            open3d.utility.Vector2iVector(pairs.astype(np.int32)),
            self._settings(self.inlier_distance(instance)),
        )
        return _moved(outcome)


def _moved(outcome: Any) -> np.ndarray | None:
    """Return the pose, or None: without tuples that pass its test, Open3D returns the identity."""
    pose = rigid_pose(outcome.transformation)
    unmoved = pose is None or np.array_equal(pose, np.eye(4))
    return None if unmoved else pose
