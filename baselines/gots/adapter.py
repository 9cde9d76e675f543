"""GoTS, reconstructed: translation by rotation-invariant features, then rotation and refinement."""

from __future__ import annotations

import numpy as np

from baselines._shared.consensus import Consensus
from baselines._shared.cubes import Incumbent, OutOfTimeError, search_cubes, with_bounds
from baselines._shared.poses import homogeneous
from baselines._shared.rotation_search import most_matches
from baselines.contract import Baseline, Instance, Limits, Solution
from baselines.gots.search import TranslationCubes, matching_translations, points_of
from dcreg.result import Trace
from dcreg.search import Budget
from dcreg.status import Status

SCOPE = (
    "translation only, objective: most source pairs whose rotation-invariant features match within eps, "
    "all translations; bounds are eps^2 (n_inliers - c) for c (c - 1) / 2 pairs, the lower one below any "
    "sum of n_inliers one-to-one squared residuals; the rotation is found after it, uncertified"
)
_TRANSLATION_TIME = 0.8  # share of the time limit; the rest is for the rotation


class Adapter(Baseline):
    """Branch and bound over translations only, with pair features."""

    def supports(self, instance: Instance) -> str | None:
        n, most = len(instance.source), self.options["max_source_points"]
        if n > most:
            return (
                f"{n} source points, more than max_source_points = {most}: their pairs are too many"
            )
        return super().supports(instance)

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        budget = limits.budget()
        translating = budget.sub_budget(_TRANSLATION_TIME)
        eps = self.inlier_distance(instance)
        problem = Consensus(instance, eps)
        incumbent = Incumbent()
        cubes = TranslationCubes(problem.source, problem.target, eps, incumbent, translating)
        centre, half = matching_translations(problem.source, problem.target, eps)
        incumbent.offer(-cubes.count(centre), centre)  # the others are centres of further cubes
        found = search_cubes(
            cubes.bound, (centre, half), incumbent, translating,
            gap_tol=0.0, floor=-float(len(cubes.pairs)), passed_on=cubes.all_pairs,
        )  # fmt: skip
        found = with_bounds(
            found, lambda value: float(eps**2 * (instance.n_inliers - points_of(-value)))
        )
        pose, turned = self._rotated(problem, incumbent.pose, budget)
        return Solution(
            found.status if turned else Status.TIME_LIMIT,
            problem.restore(problem.polish(pose) if self.options["polish"] else pose),
            lower_bound=found.lower_bound,
            upper_bound=found.upper_bound,
            gap_tol=0.0,
            certificate_scope=SCOPE,
            counters={"n_nodes": found.n_nodes},
            trace=Trace(found.events).rows(),
            extra={"matched_pairs": -incumbent.value, "matched": float(problem.count(pose))},
        )

    def _rotated(
        self, problem: Consensus, translation: np.ndarray, budget: Budget
    ) -> tuple[np.ndarray, bool]:
        """Return the pose of maximum consensus at a translation, and whether the search finished.

        Without time for the search it is the translation alone.
        """
        try:
            found = most_matches(
                problem.source + translation, problem.target, problem.radius, 0, 0, budget
            )
        except OutOfTimeError:
            return homogeneous(1.0, np.eye(3), translation), False
        return homogeneous(1.0, found.rotation, found.rotation @ translation), True
