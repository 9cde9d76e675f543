"""CLIPPER-style dense clique, a port of the published algorithm."""

from __future__ import annotations

import numpy as np

from baselines._shared.consistency import length_differences, sharing, vote_scale
from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines.clipper.dense import dense_clique
from baselines.contract import Instance
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Densest clique of the affinity graph, then least squares over its members."""

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        tolerance = 2 * self.inlier_distance(instance)
        scale = vote_scale(source, target, tolerance, instance.scale_range)
        differences = length_differences(scale * source, target)
        consistent = (differences <= tolerance) & ~sharing(pairs)
        np.fill_diagonal(consistent, True)
        sigma = self.options["sigma_factor"] * tolerance
        affinity = np.where(consistent, np.exp(-0.5 * (differences / sigma) ** 2), 0.0)
        np.fill_diagonal(affinity, 1.0)
        chosen, finished = dense_clique(affinity, consistent, budget)
        extra = {"clique_size": float(len(chosen))}
        if len(chosen) < instance.dim:
            return Estimate(None, finished, extra=extra)
        pose = fit_pose(source[chosen], target[chosen], (scale, scale))
        return Estimate(pose, finished, extra=extra)
