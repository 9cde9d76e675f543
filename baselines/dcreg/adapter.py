"""DC-Reg: the library of this repository."""

from __future__ import annotations

from typing import Any

import dcreg
from baselines._shared.front_ends import SHARED, FrontEndError, missing_matches, putative_pairs
from baselines._shared.library_search import BranchAndBound, solution_of
from baselines.contract import Card, Instance, Limits, Solution
from dcreg.driver.warm_up import warm_up_matches
from dcreg.names import JUDGES
from dcreg.status import Status

OVER_MATCHES = ("max_pairs", "certify", "judge")  # options of `dcreg.register_matches`
OVER_POINTS = ("bound", "mode", "gap_tol_factor", "polish")  # of `dcreg.register`


class Adapter(BranchAndBound):
    """Branch and bound with the holistic DC bound; over matches, where option `front_end` names some."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        if self.options["front_end"] not in (None, *SHARED):
            raise ValueError(
                f"option front_end = {self.options['front_end']!r}; choose one of "
                f"{', '.join(SHARED)}, or null for raw points"
            )
        judge, certify = self.options["judge"], self.options["certify"]
        if judge not in JUDGES:
            raise ValueError(f"option judge = {judge!r}; choose one of {', '.join(JUDGES)}")
        if certify is not None and not isinstance(certify, bool):
            raise ValueError(f"option certify = {certify!r}; give true, false or null")
        if judge != JUDGES[0] and certify:
            raise ValueError(
                f"option judge = {judge!r} tells poses over matches apart, without bounds: leave "
                "certify out"
            )

    def idle_options(self) -> dict[str, str]:
        if self.options["front_end"] is None:
            idle = dict.fromkeys(OVER_MATCHES, "without a front_end")
        else:
            idle = dict.fromkeys(OVER_POINTS, "with a front_end")
        return {**super().idle_options(), **idle}

    def supports(self, instance: Instance) -> str | None:
        return missing_matches(instance, self.options["front_end"]) or super().supports(instance)

    def warm_up(self, instance: Instance) -> None:
        if self.options["front_end"] is None:
            super().warm_up(instance)
        else:
            warm_up_matches()

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        if self.options["front_end"] is None:
            return super().solve(instance, limits)
        try:
            putative = putative_pairs(instance, self.options)
        except FrontEndError as error:
            return Solution(Status.FAILED, None, str(error))
        result = dcreg.register_matches(
            instance.source,
            instance.target,
            putative.pairs,
            inlier_distance=instance.noise_bound,
            judge=self.options["judge"],
            certify=self.options["certify"],
            time_limit=limits.time_s,
            node_limit=limits.nodes,
        )
        solution = solution_of(result)
        # of a cost that the harness does not evaluate: over the matches, those not chosen priced
        solution.lower_bound = solution.upper_bound = None
        solution.message = "; ".join(filter(None, [putative.note, solution.message]))
        solution.counters["n_correspondences"] = len(putative.pairs)
        return solution
