"""Open3D's point-to-point ICP, coarse to fine, from a documented list of initial poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines._shared import open3d_clouds
from baselines._shared.poses import rigid_pose, unit_of
from baselines._shared.prior import idle_prior
from baselines._shared.starts import STARTS, best_of_starts, check_choice
from baselines.contract import Baseline, Card, Instance, Limits, Solution
from dcreg.search import Budget


class Adapter(Baseline):
    """Three passes with a decreasing correspondence distance, for initial poses far from the optimum."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self.starts = check_choice(self, "starts", STARTS)

    def idle_options(self) -> dict[str, str]:
        return super().idle_options() | idle_prior(self.options["starts"])

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        import open3d

        open3d_clouds.quiet()
        registration = open3d.pipelines.registration
        source, target = open3d_clouds.cloud(instance.source), open3d_clouds.cloud(instance.target)
        criteria = registration.ICPConvergenceCriteria(max_iteration=self.options["max_iterations"])
        radii = unit_of(instance) * np.array(self.options["coarse_distances"])
        distances = [*radii, self.inlier_distance(instance)]

        def refine(pose: np.ndarray, budget: Budget) -> np.ndarray | None:
            for distance in distances:
                if budget.is_over:
                    break
                outcome = registration.registration_icp(
                    source,
                    target,
                    float(distance),
                    pose,
                    registration.TransformationEstimationPointToPoint(),
                    criteria,
                )
                # Too few pairs within the distance: keep the pose of the coarser pass.
                if len(outcome.correspondence_set) >= instance.dim:
                    pose = outcome.transformation
            return rigid_pose(pose)

        return best_of_starts(instance, self.starts, limits, refine)
