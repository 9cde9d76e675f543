"""GORE: guaranteed outlier removal, then RANSAC on the remaining correspondences."""

from __future__ import annotations

import numpy as np

from baselines._shared import rotation_search
from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.kernels.samples import count_within
from baselines._shared.ransac import ransac
from baselines.contract import Instance
from baselines.gore.removal import remove_outliers
from dcreg.search import Budget

SHARE_FOR_REMOVAL = 0.8  # of the time; the rest is for RANSAC


class Adapter(CorrespondenceMethod):
    """Return the better of the removal's best pose and RANSAC's on the remaining correspondences."""

    def warm_up(self, instance: Instance) -> None:
        super().warm_up(instance)
        rotation_search.warm_up()

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        bound = self.inlier_distance(instance)
        removal = remove_outliers(
            source,
            target,
            bound,
            budget.sub_budget(SHARE_FOR_REMOVAL),
            self.options["rotation_search"],
        )
        left = removal.kept
        pose, _, sampled = ransac(
            source[left],
            target[left],
            bound,
            instance.scale_range,
            seed=instance.seed,
            max_samples=self.options["max_samples"],
            confidence=self.options["confidence"],
            budget=budget,
        )
        best = removal.pose
        if pose is not None and int(count_within(source, target, pose, bound)) > removal.consensus:
            best = pose
        if best is not None and int(count_within(source, target, best, bound)) < instance.dim:
            best = None
        message = f"{len(pairs) - len(left)} of {len(pairs)} correspondences proven outliers"
        extra = {"removed": float(len(pairs) - len(left)), "consensus": float(removal.consensus)}
        return Estimate(best, removal.finished and sampled, message, extra)
