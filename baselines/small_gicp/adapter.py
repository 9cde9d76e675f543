"""small_gicp: fast local ICP and GICP."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines._shared.poses import rigid_pose, unit_of
from baselines._shared.prior import idle_prior
from baselines._shared.starts import STARTS, best_of_starts, check_choice
from baselines.contract import Baseline, Card, Instance, Limits, Solution
from dcreg.search import Budget


class Adapter(Baseline):
    """The optimiser of small_gicp on the full clouds."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self.starts = check_choice(self, "starts", STARTS)
        self.variant = check_choice(self, "variant", ("GICP", "ICP"))

    def idle_options(self) -> dict[str, str]:
        idle = super().idle_options()
        if self.options["variant"] == "ICP":
            idle["neighbours"] = "with variant: ICP"
        return idle | idle_prior(self.options["starts"])

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        import small_gicp

        def prepared(points: np.ndarray) -> Any:
            cloud = small_gicp.PointCloud(points)
            tree = small_gicp.KdTree(cloud, num_threads=limits.threads)
            neighbours = min(self.options["neighbours"], len(points))
            small_gicp.estimate_covariances(cloud, tree, neighbours, limits.threads)
            return cloud, tree

        # The thresholds of small_gicp assume coordinates of order one.
        unit = unit_of(instance)
        target, tree = prepared(instance.target / unit)
        source, _ = prepared(instance.source / unit)

        def refine(pose: np.ndarray, _budget: Budget) -> np.ndarray | None:
            outcome = small_gicp.align(
                target,
                source,
                tree,
                init_T_target_source=_in_units(pose, 1 / unit),
                registration_type=self.variant,
                max_correspondence_distance=self.options["max_distance"],
                num_threads=1,  # the order of its sums would depend on them
                max_iterations=self.options["max_iterations"],
                rotation_epsilon=self.options["epsilon"],
                translation_epsilon=self.options["epsilon"],
            )
            return rigid_pose(_in_units(outcome.T_target_source, unit))

        return best_of_starts(instance, self.starts, limits, refine)


def _in_units(pose: np.ndarray, factor: float) -> np.ndarray:
    """Return the same motion with lengths multiplied by `factor`."""
    scaled = np.array(pose)
    scaled[:3, 3] *= factor
    return scaled
