"""DC-Reg: the library of this repository."""

from __future__ import annotations

from typing import Any

from baselines._shared.front_ends import SHARED, FrontEndError, missing_matches, putative_pairs
from baselines._shared.library_search import solution_of
from baselines.contract import Baseline, Card, Instance, Limits, Solution
from dcreg.api import register, register_matches
from dcreg.driver.checks import check_bound
from dcreg.driver.modes import find_mode
from dcreg.driver.options import SolveOptions
from dcreg.driver.warm_up import compile_covers, warm_up_matches, warm_up_mode
from dcreg.families.mode import all_modes
from dcreg.families.rigid3d.kernels.boxes import FEW_PAIRS
from dcreg.names import AUTO, SCORES, mode_names
from dcreg.problem import InputError, suggestion
from dcreg.status import Status

OVER_MATCHES = ("max_pairs", "certify", "score")  # options of `dcreg.register_matches`
OVER_POINTS = ("bound", "mode", "polish", "prove")  # of `dcreg.register`
OF_BOUNDS = ("rel_gap", "abs_gap")


class Adapter(Baseline):
    """`dcreg.register`; with option `front_end`, `dcreg.register_matches` over its matches."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self._check_mode_and_bound()
        if self.options["front_end"] not in (None, *SHARED):
            raise ValueError(
                f"option front_end = {self.options['front_end']!r}; choose one of "
                f"{', '.join(SHARED)}, or null for raw points"
            )
        score, certify = self.options["score"], self.options["certify"]
        if score not in SCORES:
            raise ValueError(f"option score = {score!r}; choose one of {', '.join(SCORES)}")
        if certify is not None and not isinstance(certify, bool):
            raise ValueError(f"option certify = {certify!r}; give true, false or null")
        if score != SCORES[0] and certify:
            raise ValueError(f"option score = {score!r} has no bounds: leave certify out")

    def _check_mode_and_bound(self) -> None:
        mode, bound = self.options["mode"], self.options["bound"]
        known = {AUTO, *(entry.name for entry in all_modes())}
        if mode is not None and mode not in known:
            raise ValueError(f"option mode = {mode!r}{suggestion(str(mode), known)}")
        try:
            for entry in all_modes():
                if entry.name == mode or (mode in (None, AUTO) and entry.name == "paper"):
                    check_bound(entry, None if bound is None else str(bound))
        except InputError as error:
            raise ValueError(f"option {error}") from error

    def idle_options(self) -> dict[str, str]:
        if self.options["front_end"] is None:
            idle = dict.fromkeys(OVER_MATCHES, "without a front_end")
        else:
            idle = dict.fromkeys(OVER_POINTS, "with a front_end")
            if self.options["certify"] is False or self.options["score"] != SCORES[0]:
                idle |= dict.fromkeys(OF_BOUNDS, "without bounds")
        return {**super().idle_options(), **idle}

    def supports(self, instance: Instance) -> str | None:
        mode = self.options["mode"]
        if mode not in (None, AUTO, *mode_names(instance.model)):
            return f"mode {mode!r} does not support {instance.model}"
        return missing_matches(instance, self.options["front_end"]) or super().supports(instance)

    def warm_up(self, instance: Instance) -> None:
        """Compile the kernels of the mode, or of the modes from which the library chooses."""
        if self.options["front_end"] is not None:
            warm_up_matches()
            return
        mode, bound = self.options["mode"], self.options["bound"]
        for name in mode_names(instance.model):
            chosen_by_library = mode in (None, AUTO) and (bound is None or name == "paper")
            if chosen_by_library or name == mode:
                many = len(instance.source) * len(instance.target) > FEW_PAIRS
                warm_up_mode(find_mode(instance.model, name), bound, many=many)
                if many and bound is None and find_mode(instance.model, name).make_cover:
                    compile_covers()

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        if self.options["front_end"] is not None:
            return self._solve_matches(instance, limits)
        result = register(
            instance.source,
            instance.target,
            n_inliers=instance.n_inliers,
            model=instance.model,
            scale_range=instance.scale_range,
            rel_gap=self.options["rel_gap"],
            abs_gap=self.options["abs_gap"],
            time_limit=limits.time_s,
            node_limit=limits.nodes,
            memory_limit_mb=limits.memory_mb,
            options=SolveOptions(
                mode=self.options["mode"],
                bound=self.options["bound"],
                polish=self.options["polish"],
                prove=self.options["prove"],
                threads=limits.threads,
                assignment_limit=limits.assignments,
            ),
        )
        return solution_of(result)

    def _solve_matches(self, instance: Instance, limits: Limits) -> Solution:
        try:
            putative = putative_pairs(instance, self.options)
        except FrontEndError as error:
            return Solution(Status.FAILED, None, str(error))
        result = register_matches(
            instance.source,
            instance.target,
            putative.pairs,
            inlier_distance=instance.noise_bound,
            score=self.options["score"],
            certify=self.options["certify"],
            rel_gap=self.options["rel_gap"],
            abs_gap=self.options["abs_gap"],
            time_limit=limits.time_s,
            node_limit=limits.nodes,
        )
        solution = solution_of(result)
        # the bounds include a penalty for matches not chosen, which the harness does not evaluate
        solution.lower_bound = solution.upper_bound = None
        solution.message = "; ".join(filter(None, [putative.note, solution.message]))
        solution.counters["n_correspondences"] = len(putative.pairs)
        return solution
