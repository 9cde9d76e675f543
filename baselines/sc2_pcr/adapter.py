"""SC²-PCR, a port of the published algorithm."""

from __future__ import annotations

import numpy as np

from baselines._shared.consistency import vote_scale
from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.kernels.lengths import consistency_graph
from baselines._shared.poses import homogeneous
from baselines.contract import Instance
from baselines.sc2_pcr.consensus import best_pose, choose_seeds, refine
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Seeds, two-stage consensus sets, the pose with the most inliers, refinement."""

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        bound = self.inlier_distance(instance)
        scale = vote_scale(source, target, 2 * bound, instance.scale_range)
        source = scale * source  # rigid from here on
        rows = consistency_graph(source, target, pairs, bound, 1.0)
        most_seeds = max(1, round(self.options["seed_ratio"] * len(pairs)))
        seeds = choose_seeds(source, target, bound, most_seeds)
        sizes = self.options["first_neighbours"], self.options["second_neighbours"]
        pose, finished = best_pose(source, target, rows, seeds, sizes, bound, budget)
        if pose is None:
            return Estimate(None, finished)
        pose = refine(pose, source, target, bound)
        scaling = homogeneous(scale, np.eye(instance.dim), np.zeros(instance.dim))
        return Estimate(pose @ scaling, finished, extra={"seeds": len(seeds)})
