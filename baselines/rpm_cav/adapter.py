"""RPM-CAV: concave minimisation over matchings by simplicial branch and bound."""

from __future__ import annotations

import numpy as np

from baselines._shared.concave import Reduced
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from baselines.rpm_cav.box import BoxBound
from baselines.rpm_cav.search import Search


class Adapter(Baseline):
    """Eliminate the pose; divide the statistics of the matching into simplices."""

    def __init__(self, card: Card, **options: object) -> None:
        super().__init__(card, **options)
        if self.options["branching"] not in ("gap", "longest"):
            raise ValueError(
                f"option branching = {self.options['branching']!r}; choose one of gap, longest"
            )
        self._box_bound: BoxBound | None = None

    def warm_up(self, instance: Instance) -> None:
        """Compile every kernel, without a time limit."""
        self.solve(tiny(instance), Limits(time_s=600.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        reduced = Reduced.of(instance, limits.budget(), self.options["epsilon_factor"])
        by_gap = self.options["branching"] == "gap"
        search = Search(reduced, reduced.gap_tol, self.options["ascents"], by_gap)
        search.run()
        # The bound of the simplices; below zero, the reported lower bound is zero.
        return search.solution(simplex_bound=float(search.raw_bound * reduced.area))

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Return a lower bound for the poses of a box of theta; see `baselines.rpm_cav.box`."""
        if self._box_bound is None or self._box_bound.instance is not instance:
            self._box_bound = BoxBound(instance)
        return self._box_bound(lower, upper)
