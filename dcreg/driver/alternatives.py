"""All distinct poses that are nearly as good as the best one, or the proof that there is no other."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import count

import numpy as np

from dcreg.alternatives_result import Alternative, Alternatives
from dcreg.driver.modes import Attempt, run_mode
from dcreg.driver.normalised import NormalisedProblem
from dcreg.driver.options import Limits, SolveOptions, check_positive
from dcreg.driver.solve import Finish, Setup
from dcreg.driver.warm_up import warm_up_region
from dcreg.families.region import Far
from dcreg.problem import InputError, Problem, nearest_rotation, rms_radius, rotation_angle_deg
from dcreg.result import Result
from dcreg.search import Budget, Start, Tolerance
from dcreg.status import Status

# Default distance at which poses count as distinct: this many RMS residuals, at least a share of the size.
RESIDUALS, SHARE_OF_SIZE = 3.0, 0.01
SOLVE_SHARE = 0.5  # of the time, for the best pose


def find_alternatives(
    problem: Problem,
    limits: Limits,
    options: SolveOptions,
    *,
    ratio: float,
    distance: float | None,
    most: int,
) -> Alternatives:
    """Solve a problem, then search for other poses; see `dcreg.alternatives`."""
    _check(problem, options, ratio, distance, most)
    setup = Setup.of([problem], limits, options)
    if setup.is_sampled:  # everything then refers to the sample
        problem = setup.searched[0]
        setup = Setup.of([problem], limits, replace(options, downsample=None, mode=setup.mode.name))
    if setup.mode.in_region is None:
        raise InputError(
            f"mode: {setup.mode.name!r} cannot search for other poses; use mode 'full' with clouds of at "
            "most 4,000,000 point pairs, and omit bound"
        )
    warm_up_region(setup.mode)
    with setup.budget() as budget:
        solving = budget.isolated_sub_budget(SOLVE_SHARE)
        normalised = setup.normalised(0, solving)
        solution = run_mode(setup.mode, normalised)
        solution.events = solving.history
        best, minima = (solution.T, solution.upper_bound), solution.minima
        result = Finish(setup, 0, normalised, solving, solving).result(solution)
        search = _Search(setup, result, replace(normalised, budget=budget), distance, ratio)
        return search.run(best, minima, budget, most)


def _check(
    problem: Problem, options: SolveOptions, ratio: float, distance: float | None, most: int
) -> None:
    check_positive("ratio", ratio, minimum=1.0, optional=False)
    check_positive("distance", distance)
    check_positive("most", most, such_as=20, optional=False)
    if problem.pose_range is not None:
        raise InputError("pose_range: alternatives are searched among all poses; omit it")
    if options.certificate:
        raise InputError("certificate: a search for alternatives keeps none; omit it")


class _Search:
    """The search for other poses after a solve, in normalised units."""

    def __init__(
        self,
        setup: Setup,
        result: Result,
        normalised: NormalisedProblem,
        distance: float | None,
        ratio: float,
    ) -> None:
        self.setup, self.result, self.normalised = setup, result, normalised
        problem = setup.problems[0]
        size = rms_radius(problem.target) or rms_radius(problem.source) or 1.0
        residual = math.sqrt(result.upper_bound / result.n_inliers)
        self.distance = distance or max(RESIDUALS * residual, SHARE_OF_SIZE * size)
        own = result.n_inliers * (self.distance / RESIDUALS) ** 2
        self.threshold = max(ratio * result.upper_bound, own)

    def run(
        self,
        best: tuple[np.ndarray, float],
        minima: list[tuple[np.ndarray, float]],
        budget: Budget,
        most: int,
    ) -> Alternatives:
        """Search until no further pose is below the threshold, or until a limit."""
        known, status, lower_bound = [best], Status.CONVERGED, 0.0
        for _ in count():
            found, lower = self._next(known, minima, budget)
            if found is None:
                lower_bound, is_complete = lower, lower > self.threshold / self.setup.frame.area
                status = Status.OPTIMAL if is_complete else budget.ended_by
                break
            known.append(found)
            if len(known) > most:
                status = Status.CONVERGED
                break
        return Alternatives(
            status, self.result, self.distance, self.threshold,
            lower_bound * self.setup.frame.area, [self._described(*each) for each in known[1:]],
            budget.elapsed(),
        )  # fmt: skip

    def _next(
        self,
        known: list[tuple[np.ndarray, float]],
        minima: list[tuple[np.ndarray, float]],
        budget: Budget,
    ) -> tuple[tuple[np.ndarray, float] | None, float]:
        """Return another pose below the threshold, if one is found, and a lower bound on the others."""
        area = self.setup.frame.area
        region = Far.of(
            [T for T, _ in known], self.distance / self.setup.frame.unit, self.normalised.source
        )
        tolerance = Tolerance(rel=1e-6, target=self.threshold / area)
        problem = replace(self.normalised, region=region, tolerance=tolerance, init=None)
        attempt = Attempt(self.setup.mode, problem)
        thetas = [attempt.space.parameter(T) for T, _ in minima]
        far = [
            Start(theta, value)
            for theta, (_, value) in zip(thetas, minima, strict=True)
            if attempt.space.admissible(theta[None])[0]
        ]
        start = min(far, key=lambda each: each.value, default=Start(attempt.bound.roots[0].centre))
        found = attempt.run(budget, start)
        if found.upper_bound <= self.threshold / area:
            return (attempt.space.pose(found.theta), found.upper_bound), 0.0
        return None, found.lower_bound

    def _described(self, T: np.ndarray, value: float) -> Alternative:
        frame, best = self.setup.frame, self.result.T_certified
        pose, d = frame.pose(T), len(best) - 1
        turn = nearest_rotation(pose[:d, :d] @ np.linalg.inv(best[:d, :d]))
        source = self.setup.problems[0].source
        gaps = source @ (pose[:d, :d] - best[:d, :d]).T + pose[:d, d] - best[:d, d]
        return Alternative(
            pose, value * frame.area, abs(rotation_angle_deg(turn)),
            float(np.sqrt((gaps**2).sum(axis=1).mean())),
        )  # fmt: skip


