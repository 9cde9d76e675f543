"""The authors' SupeRANSAC through the user's `pysuperansac` package."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod
from baselines.contract import Instance
from baselines.pygcransac.adapter import from_zero, moved_back
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """MAGSAC++ scores and nested RANSAC. The package has no time limit."""

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
        rows, *origins = from_zero(instance, pairs)  # it requires boxes from 0, with their sizes
        found = package.estimateRigidTransform(rows, rows.max(axis=0), config=settings)[0]
        return moved_back(found, *origins)
