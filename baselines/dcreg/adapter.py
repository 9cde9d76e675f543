"""DC-Reg: the library of this repository."""

from __future__ import annotations

from typing import Any

import numpy as np

import dcreg
from baselines._shared.front_ends import SHARED, FrontEndError, putative_pairs
from baselines._shared.library_search import BranchAndBound, solution_of
from baselines.contract import Card, Instance, Limits, Solution, tiny
from dcreg.status import Status


class Adapter(BranchAndBound):
    """Branch and bound with the holistic DC bound; over matches, where option `front_end` names some."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        if self.options["front_end"] not in (None, *SHARED):
            raise ValueError(
                f"option front_end = {self.options['front_end']!r}; choose one of "
                f"{', '.join(SHARED)}, or null for raw points"
            )

    def supports(self, instance: Instance) -> str | None:
        front_end = self.options["front_end"]
        if front_end is not None and front_end not in instance.matches:
            return f"front end {front_end}: the data set of this instance has no shared matches"
        return super().supports(instance)

    def warm_up(self, instance: Instance) -> None:
        if self.options["front_end"] is None:
            super().warm_up(instance)
        else:
            small = tiny(instance)
            rows = np.arange(len(small.source))
            matches = np.column_stack([rows, rows])
            dcreg.register_matches(small.source, small.target, matches, inlier_distance=0.1)

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        if self.options["front_end"] is None:
            return super().solve(instance, limits)
        try:
            matches = putative_pairs(instance, self.options).pairs
        except FrontEndError as error:
            return Solution(Status.FAILED, None, str(error))
        result = dcreg.register_matches(
            instance.source,
            instance.target,
            matches,
            inlier_distance=instance.noise_bound,
            certify=self.options["certify"],
            time_limit=limits.time_s,
            node_limit=limits.nodes,
        )
        solution = solution_of(result)
        solution.counters["n_correspondences"] = len(matches)
        return solution
