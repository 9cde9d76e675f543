"""The authors' SupeRANSAC through the user's `pysuperansac` package."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod
from baselines.contract import Instance
from baselines.pygcransac.adapter import moved_back
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """MAGSAC++ scores and nested RANSAC; the package does not know of time limits."""

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        import pysuperansac as package

        settings = package.RANSACSettings()
        settings.inlier_threshold = self.inlier_distance(instance)
        settings.confidence = self.options["confidence"]
        settings.max_iterations = self.options["max_samples"]
        settings.min_iterations = min(1000, settings.max_iterations)
        settings.scoring = package.ScoringType.MAGSAC
        settings.local_optimization = package.LocalOptimizationType.NestedRANSAC
        settings.final_optimization = package.LocalOptimizationType.LSQ
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        low_source, low_target = source.min(axis=0), target.min(axis=0)
        both = np.ascontiguousarray(np.hstack([source - low_source, target - low_target]))
        # It takes boxes from 0, with their sizes.
        pose = package.estimateRigidTransform(both, both.max(axis=0), config=settings)[0]
        return None if pose is None else moved_back(np.asarray(pose).T, low_source, low_target)
