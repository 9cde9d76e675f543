"""Official TEASER++ through its Python binding."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import homogeneous
from baselines.contract import Instance
from dcreg.problem import nearest_rotation
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Maximum clique of consistent pairs, GNC-TLS rotation, voted translation; scale fixed to 1."""

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        from teaserpp_python import RobustRegistrationSolver as Solver

        settings = Solver.Params()
        settings.cbar2 = 1.0
        settings.noise_bound = self.inlier_distance(instance)
        settings.estimate_scaling = False
        settings.rotation_estimation_algorithm = Solver.ROTATION_ESTIMATION_ALGORITHM.GNC_TLS
        settings.rotation_gnc_factor = 1.4
        settings.rotation_max_iterations = 100
        settings.rotation_cost_threshold = self.options["rotation_cost_threshold"]
        left = budget.left()
        if left is not None:
            settings.max_clique_time_limit = max(1e-3, left)
        solver = Solver(settings)
        solver.solve(instance.source[pairs[:, 0]].T, instance.target[pairs[:, 1]].T)
        found = solver.getSolution()
        # The binding reports no validity; a clique of one pair determines no rotation.
        if len(solver.getInlierMaxClique()) < 2 or not np.isfinite(found.rotation).all():
            return None
        return homogeneous(1.0, nearest_rotation(found.rotation), np.ravel(found.translation))
