"""Methods on the library's search: `dcreg.register` itself, and modes of a method's own."""

from __future__ import annotations

import abc
from typing import Any

import numpy as np

import dcreg
from baselines._shared.single_boxes import bound_of_box
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from dcreg.driver.modes import CHOSEN, MODES, Mode, find_mode
from dcreg.driver.solve import result_of, task_of
from dcreg.driver.task import Answer, Task
from dcreg.driver.warm_up import warm_up_mode
from dcreg.families.dc.registry import bound_parts, make_bound
from dcreg.names import AUTO, DEFAULT_BOUND, bound_names, mode_names
from dcreg.problem import InputError, Problem, default_gap_tol, suggestion
from dcreg.result import Result


class LibraryMethod(Baseline):
    """Tolerance of every method on the library's search."""

    def gap_tol(self, instance: Instance) -> float:
        """The library's default tolerance, with the card's `gap_tol_factor`."""
        return default_gap_tol(
            instance.source, instance.target, instance.n_inliers, self.options["gap_tol_factor"]
        )


class BranchAndBound(LibraryMethod):
    """`dcreg.register` with the bound and the mode of the options.

    Attributes
    ----------
    bounds : tuple of str
        Those the method's card speaks for. Where they are not all of the library, null, the library's own
        bound, is refused.
    mode : str, optional
        That of the option `mode`, if the card has one; null: the library chooses.
    """

    bounds: tuple[str, ...] = tuple(bound_names())
    mode: str | None = None

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        if "mode" in self.options:
            self.mode = self.options["mode"]
        self._check_mode()
        self._check_bound()

    def _check_mode(self) -> None:
        known = {AUTO, *(name for model in self.card.models for name in mode_names(model))}
        if self.mode is not None and self.mode not in known:
            raise ValueError(f"option mode = {self.mode!r}{suggestion(str(self.mode), known)}")

    def _check_bound(self) -> None:
        bound = self.options["bound"]
        if bound is None:
            if DEFAULT_BOUND not in self.bounds:
                raise ValueError(
                    "option bound = null is the library's own bound; choose from "
                    f"{', '.join(self.bounds)}"
                )
            return
        try:
            bound_parts(str(bound))
        except InputError as error:
            raise ValueError(f"option {error}") from error
        if not set(bound.split("+")) <= set(self.bounds):
            raise ValueError(f"option bound = {bound!r}{suggestion(bound, self.bounds)}")
        chosen = [
            entry for entry in MODES if entry.name == self.mode and entry.model in self.card.models
        ]
        if chosen and not any(entry.takes_bound for entry in chosen):
            raise ValueError(
                f"option bound = {bound!r}, but mode {self.mode!r} has bounds of its own; leave one of "
                "them out"
            )

    def supports(self, instance: Instance) -> str | None:
        if self.mode not in (None, AUTO, *mode_names(instance.model)):
            return f"mode {self.mode!r} does not treat {instance.model}"
        return super().supports(instance)

    def warm_up(self, instance: Instance) -> None:
        """The kernels of the mode, or of those that the library chooses among."""
        bound = self.options["bound"]
        names = set(CHOSEN if bound is None else ["paper"])
        if self.mode not in (None, AUTO):
            names = {self.mode}
        for name in mode_names(instance.model):
            if name in names:
                warm_up_mode(find_mode(instance.model, name), bound)

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        result = dcreg.register(
            instance.source,
            instance.target,
            n_inliers=instance.n_inliers,
            model=instance.model,
            scale_range=instance.scale_range,
            gap_tol=self.gap_tol(instance),
            time_limit=limits.time_s,
            node_limit=limits.nodes,
            memory_limit_mb=limits.memory_mb,
            options=dcreg.SolveOptions(
                mode=self.mode,
                bound=self.options["bound"],
                polish=self.options["polish"],
                threads=limits.threads,
            ),
        )
        return solution_of(result)

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """The bound of the options over one box; see `baselines.contract.BoxBounding`."""
        name = self.options["bound"] or DEFAULT_BOUND
        return bound_of_box(
            lambda space, roots: make_bound(name, space, roots), instance, lower, upper
        )


class ModeOfItsOwn(LibraryMethod):
    """A method that replaces the library's modes by one of its own: problem, frame and polish stay.

    Attributes
    ----------
    own_bound : str
        What the bound of its search is called in results.
    """

    own_bound: str

    @abc.abstractmethod
    def run(self, task: Task) -> Answer:
        """Solve the normalised task."""

    def warm_up(self, instance: Instance) -> None:
        self.solve(tiny(instance), Limits(time_s=30.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        problem = Problem(
            instance.source, instance.target, instance.n_inliers, instance.model,
            instance.scale_range,
        )  # fmt: skip
        mode = Mode(
            self.card.display_name, problem.model, self.run, self.card.summary,
            takes_bound=False, own_bound=self.own_bound,
        )  # fmt: skip
        mode.check(problem, None, certificate=False)
        budget = limits.budget()
        task = task_of(problem, mode, None, self.gap_tol(instance), limits.threads, budget)
        answer = self.run(task)
        result = result_of(
            problem, mode, task, answer, polish=self.options["polish"], time_setup_s=0.0
        )
        return solution_of(result)


def solution_of(result: Result) -> Solution:
    """A result of the library as the contract wants it; its message tells what ran."""
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
