"""Fast global registration on FPFH correspondences, Open3D."""

from __future__ import annotations

import numpy as np

from baselines._shared import open3d_clouds
from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import rigid_pose
from baselines.contract import Instance
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Graduated non-convexity with line processes over the pairs that pass the tuple test."""

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
            registration.FastGlobalRegistrationOption(
                # With the absolute scale, lengths of the option are in target units.
                use_absolute_scale=True,
                decrease_mu=True,
                maximum_correspondence_distance=self.inlier_distance(instance),
                iteration_number=self.options["max_iterations"],
                maximum_tuple_count=self.options["max_tuples"],
                tuple_test=self.options["tuple_test"],
            ),
        )
        pose = rigid_pose(outcome.transformation)
        # Open3D returns the identity, not an error, if no tuple passes its test.
        unmoved = pose is None or np.array_equal(pose, np.eye(4))
        return None if unmoved else pose
