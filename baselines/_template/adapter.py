"""METHOD_NAME: describe the method in one line."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from baselines._shared.poses import homogeneous
from baselines.contract import Baseline, Instance, Limits, Solution
from dcreg.problem import apply_pose, rms_radius
from dcreg.problem.geometry import fit_pose
from dcreg.status import Status


class Adapter(Baseline):
    """Replace this class body by your method. The example is a plain ICP from the centroids.

    ``python -m baselines.check`` checks that an adapter

    - does not change the arrays of the instance,
    - stops with the best pose so far once ``limits.budget()`` is over,
    - draws random numbers from ``instance.seed`` only,
    - reports OPTIMAL and bounds only if they are proven.

    It should import heavy packages inside `solve`.
    """

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        budget, tree = limits.budget(), cKDTree(instance.target)
        # The pose T maps source points to target coordinates: centroids and sizes first.
        size = rms_radius(instance.target) / rms_radius(instance.source)
        scale = np.clip(size, *instance.scale_range)
        shift = instance.target.mean(axis=0) - scale * instance.source.mean(axis=0)
        T = homogeneous(scale, np.eye(instance.dim), shift)
        for _ in range(self.options["max_iterations"]):
            _, nearest = tree.query(apply_pose(T, instance.source))
            T = fit_pose(instance.source, instance.target[nearest], (scale, scale))
            if budget.is_over:
                return Solution(Status.TIME_LIMIT, T)
        return Solution(Status.CONVERGED, T)
