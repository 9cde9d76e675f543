"""Methods that run the library's branch and bound with their own bound."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from baselines._shared.single_boxes import bound_of_box, box_space
from baselines.contract import Baseline, Instance, Limits, Solution, tiny
from dcreg.driver import options
from dcreg.driver.modes import find_mode
from dcreg.driver.solve import register_problem
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.mode import Mode
from dcreg.names import DEFAULT_REL_GAP
from dcreg.problem import Problem
from dcreg.result import Result
from dcreg.search import Bound, Box


class OwnBound(Baseline):
    """A method that differs from mode `paper` of the library in the bound.

    Normalisation, start box, first incumbent, branching, tolerances and polish are those of the library.
    Its stage `distances` is left out, as for each bound that the user names.

    Attributes
    ----------
    own_bound : str
        Name of the bound in results.
    bounds : tuple of str
        Names of its bounds, values of the option `bound`; comparisons show each of them. Empty for a
        method with one bound.
    """

    own_bound: str
    bounds: tuple[str, ...] = ()

    @abc.abstractmethod
    def make_bound(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> Bound:
        """Return the method's bound over the boxes that bisection makes of `roots`."""

    def mode(self, model: str) -> Mode:
        """Return mode `paper` with the bound of the method."""
        return replace(
            find_mode(model, "paper"), name=self.card.display_name, make_bound=self.make_bound,
            make_cover=None, own_bound=self.own_bound, certifies="",
        )  # fmt: skip

    def warm_up(self, instance: Instance) -> None:
        self.solve(tiny(instance), Limits(time_s=30.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        problem = Problem(
            instance.source, instance.target, instance.n_inliers, instance.model,
            instance.scale_range,
        )  # fmt: skip
        return solution_of(self.result(problem, limits))

    def result(
        self,
        problem: Problem,
        limits: Limits,
        rel_gap: float = DEFAULT_REL_GAP,
        abs_gap: float | None = None,
    ) -> Result:
        """Return what `dcreg.register` would return if the method were a mode of the library."""
        return register_problem(
            problem,
            options.Limits(rel_gap, abs_gap, None, limits.time_s, limits.nodes, limits.memory_mb),
            options.SolveOptions(
                threads=limits.threads,
                polish=self.options["polish"],
                prove=True,
                assignment_limit=limits.assignments,
            ),
            self.mode(problem.model),
        )

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Return the bound over one box; see `baselines.contract.BoxBounding`."""
        value, _ = bound_of_box(self.make_bound, box_space(instance), Box(lower, upper))
        return value


def solution_of(result: Result) -> Solution:
    """Convert a result of the library to the contract's; the message names mode and bound."""
    return Solution(
        status=result.status,
        T_target_source=result.T_target_source,
        message=f"mode {result.mode}, bound {result.bound}",
        lower_bound=result.lower_bound,
        upper_bound=result.upper_bound,
        gap_tol=result.gap_tol,
        certificate_scope=result.certificate_scope,
        counters={"n_nodes": result.n_nodes, "n_assignments": result.n_assignments},
        trace=result.trace.rows(),
        extra={
            "objective": result.objective,
            "objective_certified": result.objective_certified,
        },
    )
