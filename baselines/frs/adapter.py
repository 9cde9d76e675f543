"""Rotation search nested in a translation search: the largest consensus over all rigid poses."""

from __future__ import annotations

import time

from baselines._shared import rotation_search
from baselines._shared.consensus import Consensus
from baselines._shared.cubes import Incumbent, OctreeSearch
from baselines.contract import Baseline, Instance, Limits, Solution
from baselines.frs.search import TranslationCubes, matching_translations

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
        began = time.perf_counter()
        radius = self.options["noise_factor"] * instance.noise_bound
        problem = Consensus(instance, radius)
        incumbent = Incumbent()
        deadline = began + limits.time_s
        for pose, count in problem.starts(self.options["start_rotations"], deadline):
            incumbent.offer(-count, pose)
        slack = int(self.options["rotation_slack"] * len(problem.source))
        cubes = TranslationCubes(problem, incumbent, slack, deadline)
        search = OctreeSearch(
            cubes.bound, incumbent, 0.0, limits, began, deadline,
            unit=radius**2, offset=radius**2 * instance.n_inliers, floor=-float(len(problem.source)),
        )  # fmt: skip
        status = search.run([matching_translations(problem.source, problem.target, radius)])
        polished = problem.polish(incumbent.pose) if self.options["polish"] else incumbent.pose
        return Solution(
            status,
            problem.restore(polished),
            lower_bound=search.trace[-1]["lower_bound"],
            upper_bound=search.trace[-1]["upper_bound"],
            gap_tol=0.0,
            certificate_scope=SCOPE,
            counters={"n_nodes": search.n_nodes, "n_rotation_cubes": cubes.n_rotation_cubes},
            trace=search.trace,
            extra={"matched": -incumbent.value, "matched_polished": problem.count(polished)},
        )
