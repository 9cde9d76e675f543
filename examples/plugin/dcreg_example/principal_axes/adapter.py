"""Principal axes, then ICP."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from baselines.contract import Baseline, Instance, Limits, Solution
from dcreg.problem import apply_pose, rms_radius
from dcreg.problem.geometry import fit_pose
from dcreg.status import Status

from ..axes import rotations


class Adapter(Baseline):
    """Refine the pose of each assignment of principal axes by ICP, and keep the best."""

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        budget, tree = limits.budget(), cKDTree(instance.target)
        source, target = instance.source, instance.target
        scale = np.clip(rms_radius(target) / max(rms_radius(source), 1e-12), *instance.scale_range)
        best, best_error = np.eye(instance.dim + 1), np.inf
        for rotation in rotations(source, target):
            T = np.eye(instance.dim + 1)
            T[:-1, :-1] = scale * rotation
            T[:-1, -1] = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
            for _ in range(self.options["max_iterations"]):
                nearest = tree.query(apply_pose(T, source))[1]
                T = fit_pose(source, target[nearest], (scale, scale))
            error = float((tree.query(apply_pose(T, source))[0] ** 2).mean())
            if error < best_error:
                best, best_error = T, error
            if budget.is_over:
                return Solution(Status.TIME_LIMIT, best)
        return Solution(Status.CONVERGED, best)
