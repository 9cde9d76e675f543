"""Trimmed ICP from a documented list of initial poses, 2D similarity and 3D rigid."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from baselines._shared.starts import STARTS, best_of_starts, check_choice
from baselines.contract import Baseline, Card, Instance, Limits, Solution
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget


class Adapter(Baseline):
    """Alternate nearest neighbours and the closed-form fit to the closest `n_inliers` of them."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self.starts = check_choice(self, "starts", STARTS)

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        tree = cKDTree(instance.target)
        n_kept = instance.n_inliers if self.options["trim"] else len(instance.source)

        def refine(pose: np.ndarray, budget: Budget) -> np.ndarray:
            last_cost = np.inf
            for _ in range(self.options["max_iterations"]):
                distances, nearest = tree.query(apply_pose(pose, instance.source))
                kept = np.argsort(distances, kind="stable")[:n_kept]
                cost = float((distances[kept] ** 2).sum())
                if last_cost - cost <= self.options["tolerance"] * cost:
                    break
                last_cost = cost
                pose = fit_pose(
                    instance.source[kept], instance.target[nearest[kept]], instance.scale_range
                )
                if budget.is_over:
                    break
            return pose

        return best_of_starts(instance, self.starts, limits, refine)
