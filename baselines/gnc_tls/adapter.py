"""Graduated non-convexity for truncated least squares on given correspondences."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.robust import gnc_pose
from baselines.contract import Instance
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Weighted least squares; the weights change from equal to inlier or outlier."""

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        pose, weights, finished = gnc_pose(
            instance.source[pairs[:, 0]],
            instance.target[pairs[:, 1]],
            self.inlier_distance(instance),
            instance.scale_range,
            budget,
        )
        return Estimate(pose, finished, extra={"inliers": int((weights >= 0.5).sum())})
