"""RPM-PA: concave minimisation over matchings by polyhedral annexation."""

from __future__ import annotations

from baselines._shared.concave import Reduced
from baselines.contract import Baseline, Instance, Limits, Solution, tiny
from baselines.rpm_pa.search import Search


class Adapter(Baseline):
    """The published tolerance by default; ``epsilon0: 0`` for the exact variant."""

    def warm_up(self, instance: Instance) -> None:
        """Compile every kernel, without a time limit."""
        self.solve(tiny(instance), Limits(time_s=600.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        reduced = Reduced.of(
            instance, limits.budget(), self.options["epsilon_factor"], self.options["local_search"]
        )
        search = Search(reduced, reduced.gap_tol, self.options["epsilon0"])
        search.run()
        return search.solution()
