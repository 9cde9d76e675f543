"""Methods on the library's search: `dcreg.register` itself, and modes of a method's own."""

from __future__ import annotations

import abc
from typing import Any

import numpy as np

import dcreg
from baselines._shared.single_boxes import bound_of_box
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from dcreg.bounds import DEFAULT_BOUND, bound_names, bound_parts, make_bound
from dcreg.modes import AUTO, MODES, Answer, Mode, Task, mode_names
from dcreg.problem import InputError, Problem, default_gap_tol, suggestion
from dcreg.registration import result_of, task_of
from dcreg.result import Result
from dcreg.search import Budget


class LibraryMethod(Baseline):
    """Tolerance, warm-up and answer of every method on the library's search."""

    def warm_up(self, instance: Instance) -> None:
        self.solve(tiny(instance), Limits(time_s=30.0, nodes=100))

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
        Those the method's card speaks for.
    modes : tuple of str, optional
        Likewise; default: all of the library. A method that stands for its bounds names modes that take
        one, and has no bound of null, which would be the library's own.
    """

    bounds: tuple[str, ...] = tuple(bound_names())
    modes: tuple[str, ...] | None = None

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self._check_mode()
        self._check_bound()

    def _check_mode(self) -> None:
        mode = self.options["mode"]
        known = {AUTO, *(name for model in self.card.models for name in mode_names(model))}
        if self.modes is not None:
            known = set(self.modes)
        elif mode is None:
            return
        if mode not in known:
            raise ValueError(f"option mode = {mode!r}{suggestion(str(mode), known)}")

    def _check_bound(self) -> None:
        bound, mode = self.options["bound"], self.options["mode"]
        if bound is None:
            if self.modes is not None:
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
            entry for entry in MODES if entry.name == mode and entry.model in self.card.models
        ]
        if chosen and not any(entry.takes_bound for entry in chosen):
            raise ValueError(
                f"option bound = {bound!r}, but mode {mode!r} has bounds of its own; leave one of "
                "them out"
            )

    def supports(self, instance: Instance) -> str | None:
        mode = self.options["mode"]
        if mode not in (None, AUTO, *mode_names(instance.model)):
            return f"mode {mode!r} does not treat {instance.model}"
        return super().supports(instance)

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        result = dcreg.register(
            instance.source,
            instance.target,
            n_inliers=instance.n_inliers,
            model=instance.model,
            mode=self.options["mode"],
            bound=self.options["bound"],
            scale_range=instance.scale_range,
            gap_tol=self.gap_tol(instance),
            polish=self.options["polish"],
            time_limit=limits.time_s,
            node_limit=limits.nodes,
            memory_limit_mb=limits.memory_mb,
            threads=limits.threads,
        )
        return solution_of(result)

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """The bound of the options over one box; see `baselines.contract.BoxBounding`."""
        name = self.options["bound"] or DEFAULT_BOUND
        return bound_of_box(
            lambda space, roots: make_bound(name, space, roots), instance, lower, upper
        )


class ModeOfItsOwn(LibraryMethod):
    """A method that replaces the library's modes by one of its own: problem, frame and polish stay."""

    @abc.abstractmethod
    def run(self, task: Task) -> Answer:
        """Solve the normalised task."""

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        problem = Problem(
            instance.source, instance.target, instance.n_inliers, instance.model,
            instance.scale_range,
        )  # fmt: skip
        mode = Mode(self.card.display_name, problem.model, self.run, self.card.summary)
        budget = Budget(limits.time_s, limits.nodes, limits.memory_mb)
        task = task_of(problem, mode, None, self.gap_tol(instance), limits.threads, budget)
        answer = self.run(task)
        result = result_of(
            problem, mode, task, answer, polish=self.options["polish"],
            time_setup_s=0.0,
        )  # fmt: skip
        return solution_of(result)


def solution_of(result: Result) -> Solution:
    """A result of the library as the contract wants it."""
    return Solution(
        status=result.status,
        T_target_source=result.T_target_source,
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
