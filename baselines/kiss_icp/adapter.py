"""KISS-ICP's registration step for a single pair of clouds."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines._shared.poses import rigid_pose, unit_of
from baselines._shared.prior import idle_prior
from baselines._shared.starts import STARTS, best_of_starts, check_choice
from baselines.contract import Baseline, Card, Instance, Limits, Solution
from dcreg.search import Budget


class Adapter(Baseline):
    """The target is the map. Motion model and deskewing need a sequence."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self.starts = check_choice(self, "starts", STARTS)

    def idle_options(self) -> dict[str, str]:
        return super().idle_options() | idle_prior(self.options["starts"])

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        from kiss_icp.mapping import VoxelHashMap
        from kiss_icp.registration import Registration

        unit = unit_of(instance)
        distance = self.options["max_distance"] * unit
        voxel_map = VoxelHashMap(
            # Neighbours are searched in adjacent voxels only, so a voxel is as large as the distance.
            # The map leaves out points that are much closer to each other than a voxel.
            voxel_size=distance,
            max_distance=1e6 * unit,
            max_points_per_voxel=len(instance.target),
        )
        voxel_map.add_points(np.array(instance.target))  # the binding refuses read-only arrays
        registration = Registration(
            max_num_iterations=self.options["max_iterations"],
            convergence_criterion=self.options["epsilon"],
            max_num_threads=limits.threads,
        )

        def refine(pose: np.ndarray, _budget: Budget) -> np.ndarray | None:
            # As in the odometry: the robust kernel is a third of the correspondence distance.
            found = registration.align_points_to_map(
                points=np.array(instance.source),
                voxel_map=voxel_map,
                initial_guess=pose,
                max_correspondance_distance=distance,
                kernel=distance / 3,
            )
            return rigid_pose(found)

        return best_of_starts(instance, self.starts, limits, refine)
