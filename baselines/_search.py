"""`dcreg.register` as a method; the branch-and-bound folders on it differ by their bounds only."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

import dcreg
from baselines._boxes import bound_of_box
from baselines._poses import rms_radius
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from dcreg.bounds import bound_names, make_bound
from dcreg.registration import MODES


class BranchAndBound(Baseline):
    """Best-first search of the library with the bound its options name."""

    bounds: tuple[str, ...] = tuple(bound_names())  # those its card speaks for

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        bound, mode = self.options["bound"], self.options["mode"]
        if not set(bound.split("+")) <= set(self.bounds):
            known = ", ".join(self.bounds)
            raise ValueError(f"option bound = {bound!r}; choose from {known} or join some with '+'")
        modes = [name for model in card.models for name in MODES[model]]
        if mode is not None and mode not in modes:
            raise ValueError(f"option mode = {mode!r}; choose one of {sorted(set(modes))} or null")

    def supports(self, instance: Instance) -> str | None:
        mode = self.options["mode"]
        if mode is not None and mode not in MODES[instance.model]:
            return f"mode {mode!r} does not treat {instance.model}"
        return super().supports(instance)

    def warm_up(self, instance: Instance) -> None:
        self.solve(tiny(instance), Limits(time_s=30.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        region: dict[str, Any] = {}
        if instance.model == "similarity2d":
            region["scale_range"] = instance.scale_range
        result = dcreg.register(
            instance.source,
            instance.target,
            n_inliers=instance.n_inliers,
            model=instance.model,
            mode=self.options["mode"],
            bound=self.options["bound"],
            gap_tol=self.gap_tol(instance),
            polish=self.options["polish"],
            time_limit=limits.time_s,
            node_limit=limits.nodes,
            memory_limit_mb=limits.memory_mb,
            threads=limits.threads,
            **region,
        )
        return Solution(
            status=result.status,
            T_target_source=result.T_target_source,
            lower_bound=result.lower_bound,
            upper_bound=result.upper_bound,
            gap_tol=result.gap_tol,
            certificate_scope=result.certificate_scope,
            counters={
                "n_nodes": result.n_nodes,
                "n_assignments": result.n_assignments,
                "n_bound_evals": result.n_bound_evals,
            },
            trace=result.trace.rows(),
            extra={
                "objective": result.objective,
                "objective_certified": result.objective_certified,
            },
        )

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """The bound of the options over one box; see `baselines.contract.BoxBounding`."""
        make = functools.partial(make_bound, self.options["bound"])
        return bound_of_box(make, instance, lower, upper)

    def gap_tol(self, instance: Instance) -> float:
        """Absolute tolerance: `gap_tol_factor` times the target's RMS radius, per matched pair."""
        length = self.options["gap_tol_factor"] * rms_radius(instance.target)
        return float(instance.n_inliers * length**2)
