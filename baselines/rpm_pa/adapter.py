"""RPM-PA: concave minimisation over matchings by polyhedral annexation."""

from __future__ import annotations

from baselines._shared.concave import SCOPE, Reduced
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from baselines.rpm_pa.search import Search, Settings
from dcreg.problem import default_gap_tol
from dcreg.search import Budget


class Adapter(Baseline):
    """The published tolerance by default; ``epsilon0: 0`` for the exact variant."""

    def __init__(self, card: Card, **options: object) -> None:
        super().__init__(card, **options)
        if self.options["epsilon0"] < 0:
            raise ValueError(f"option epsilon0 = {self.options['epsilon0']}; give 0 or more")

    def warm_up(self, instance: Instance) -> None:
        """Compiles every kernel, however long a loaded machine takes."""
        self.solve(tiny(instance), Limits(time_s=600.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        budget = Budget(limits.time_s, limits.nodes, limits.memory_mb)
        reduced = Reduced.of(instance, budget)
        gap_tol = default_gap_tol(
            instance.source, instance.target, instance.n_inliers, self.options["gap_tol_factor"]
        )
        search = Search(reduced, Settings(gap_tol / reduced.area, self.options["epsilon0"]), budget)
        search.run()
        assert search.status is not None
        return Solution(
            search.status,
            reduced.pose(),
            lower_bound=search.lower_bound * reduced.area,
            upper_bound=search.upper_bound * reduced.area,
            gap_tol=gap_tol,
            certificate_scope=SCOPE,
            counters={
                "n_nodes": search.n_facets_tested,
                "n_assignments": search.n_assignments,
            },
            trace=search.history.rows,
            extra={"n_dimensions": float(search.dim)},
        )
