"""FRS: a rotation search nested in a translation search, for the maximum consensus of rigid poses."""

from __future__ import annotations

import numpy as np

from baselines._shared import rotation_search
from baselines._shared.consensus import Consensus
from baselines._shared.cubes import Incumbent, search_cubes, with_bounds
from baselines._shared.poses import homogeneous
from baselines.contract import Baseline, Instance, Limits, Solution
from baselines.frs.search import TranslationCubes, matching_translations
from dcreg.result import Trace

SCOPE = (
    "rigid pose, many-to-one consensus: most source points within xi of the target, all rotations and "
    "translations; bounds are xi^2 (n_inliers - count), below any sum of n_inliers squared residuals"
)


class Adapter(Baseline):
    """Branch and bound over translations and rotations for the number of matched points."""

    def warm_up(self, instance: Instance) -> None:
        super().warm_up(instance)
        rotation_search.warm_up()

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        budget = limits.budget()
        radius = self.inlier_distance(instance)
        problem = Consensus(instance, radius)
        centre, half = matching_translations(problem.source, problem.target, radius)
        incumbent, first = Incumbent(), homogeneous(1.0, np.eye(3), centre)
        incumbent.offer(-problem.count(first), first)  # a pose, even without time for a search
        slack = int(self.options["rotation_slack"] * len(problem.source))
        cubes = TranslationCubes(problem, incumbent, slack, budget)
        found = search_cubes(
            cubes.bound, (centre, half), incumbent, budget,
            gap_tol=0.0, floor=-float(len(problem.source)),
        )  # fmt: skip
        found = with_bounds(found, lambda value: radius**2 * (instance.n_inliers + value))
        polished = problem.polish(incumbent.pose) if self.options["polish"] else incumbent.pose
        return Solution(
            found.status,
            problem.restore(polished),
            lower_bound=found.lower_bound,
            upper_bound=found.upper_bound,
            gap_tol=0.0,
            certificate_scope=SCOPE,
            counters={"n_nodes": found.n_nodes, "n_rotation_cubes": cubes.n_rotation_cubes},
            trace=Trace(found.events).rows(),
            extra={"matched": -incumbent.value, "matched_polished": problem.count(polished)},
        )
