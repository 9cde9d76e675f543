"""GORE: a pose by RANSAC, guaranteed outlier removal, then RANSAC on the remaining correspondences."""

from __future__ import annotations

import numpy as np

from baselines._shared import rotation_search
from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.kernels.samples import count_within
from baselines._shared.ransac import ransac
from baselines.contract import Instance
from baselines.gore.removal import remove_outliers
from dcreg.search import Budget

SHARE_FOR_START = 0.1  # of the time, at most
SHARE_FOR_REMOVAL = 0.8  # of the remaining time


class Adapter(CorrespondenceMethod):
    """Return the better of the removal's best pose and RANSAC's on the remaining correspondences."""

    def warm_up(self, instance: Instance) -> None:
        super().warm_up(instance)
        rotation_search.warm_up()

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        bound = self.inlier_distance(instance)
        start, _, _ = self._ransac(
            instance, source, target, bound, budget.sub_budget(SHARE_FOR_START)
        )
        removal = remove_outliers(
            source,
            target,
            bound,
            budget.sub_budget(SHARE_FOR_REMOVAL),
            self.options["rotation_search"],
            start,
        )
        left = removal.kept
        pose, _, sampled = self._ransac(instance, source[left], target[left], bound, budget)
        best = removal.pose
        if pose is not None and int(count_within(source, target, pose, bound)) > removal.consensus:
            best = pose
        if best is not None and int(count_within(source, target, best, bound)) < instance.dim:
            best = None
        message = f"{len(pairs) - len(left)} of {len(pairs)} correspondences proven outliers"
        extra = {"removed": float(len(pairs) - len(left)), "consensus": float(removal.consensus)}
        return Estimate(best, removal.finished and sampled, message, extra)

    def _ransac(
        self,
        instance: Instance,
        source: np.ndarray,
        target: np.ndarray,
        bound: float,
        budget: Budget,
    ) -> tuple[np.ndarray | None, int, bool]:
        return ransac(
            source,
            target,
            bound,
            instance.scale_range,
            seed=instance.seed,
            max_samples=self.options["max_samples"],
            confidence=self.options["confidence"],
            budget=budget,
        )
