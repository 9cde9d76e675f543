"""RANSAC on given correspondences."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.ransac import ransac
from baselines.contract import Instance
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Find the pose of a sample with the most inliers, refitted to these."""

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        pose, n_samples, finished = ransac(
            instance.source[pairs[:, 0]],
            instance.target[pairs[:, 1]],
            self.inlier_distance(instance),
            instance.scale_range,
            seed=instance.seed,
            max_samples=self.options["max_samples"],
            confidence=self.options["confidence"],
            budget=budget,
        )
        return Estimate(pose, finished, extra={"samples": n_samples})
