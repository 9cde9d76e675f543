"""RPM-PA: concave minimisation over matchings by polyhedral annexation."""

from __future__ import annotations

import time

from baselines._concave import SCOPE, Reduced
from baselines._poses import rms_radius
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from baselines.rpm_pa.search import Search, Settings


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
        began = time.perf_counter()
        reduced = Reduced.of(instance)
        length = self.options["gap_tol_factor"] * rms_radius(instance.target)
        gap_tol = float(instance.n_inliers * length**2)
        search = Search(
            reduced, Settings(gap_tol / reduced.area, self.options["epsilon0"]), limits, began
        )
        search.run()
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
            trace=search.trace,
            extra={"n_dimensions": float(search.dim)},
        )
