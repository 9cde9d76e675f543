"""Solve for several cardinalities, to choose one if `n_inliers` is unknown.

Let E_k(theta) be the minimum sum of squared residuals of k one-to-one pairs at a pose. The k cheapest
pairs of an optimal matching of k' > k pairs cost at most the fraction k / k' of it, and they are a
matching of k pairs. Hence

    E_k(theta) / k <= E_k'(theta) / k'   for every theta, and therefore for the minima over theta.

A lower bound for k, multiplied by k' / k, is thus a lower bound for k' (*transfer*). A search for k that
ends slightly below its own tolerance often proves a whole run of larger cardinalities. With the upper
bounds U and the allowed gaps eps, this condition suffices:

    lower_bound_k >= (k / k') (U_k' - eps_k')   for every k' of the run.

The search then needs a gap of U_k minus the maximum of the right sides. As long as the additional points
fit as well as the others, the bounds per pair hardly change and one search serves many cardinalities.
Once outliers are added, every cardinality needs a separate search, over a separate, smaller start box.

Poses are exchanged in both directions: the best pose for k is refined and tried for the neighbours of k;
when the time is up it is tried without refinement. Results are completed from the largest cardinality
down, because their pairs and poses are candidates for fewer pairs.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dcreg.assignment.objective import Matched
from dcreg.driver.downsample import SEARCH_SHARE
from dcreg.driver.modes import (
    Attempt,
    attempts,
    recover_pose,
    search_share,
    shifted_rotation,
)
from dcreg.driver.normalised import NormalisedProblem, Solution
from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.solve import Finish, Setup
from dcreg.problem import InputError, Problem, apply_pose
from dcreg.result import Result, Stage
from dcreg.search import Budget, Event, Interrupted, Start, Tolerance
from dcreg.status import Status
from dcreg.sweep_result import SweepResult

# To prove larger cardinalities as well, a search may get this fraction of its own tolerance. With less,
# the search costs more than those it saves.
TIGHTEST_SHARE = 0.5
# Share of the time for the local searches of all numbers of pairs together.
STARTING_SHARE = 0.5
# Approximate time for refining a pose on all points. It is reserved for every cardinality, up to this
# share of the time.
_ENDING_S_PER_POINT = 2e-5
_LARGEST_ENDING = 0.75


def sweep_problems(
    problems: Sequence[Problem], limits: Limits, options: SolveOptions
) -> SweepResult:
    """Solve problems that differ in `n_inliers`, given in ascending order; see `dcreg.sweep`."""
    if options.certificate:
        raise InputError("certificate: a sweep keeps none; use register for one n_inliers")
    options.refuse_checkpoint()
    setup = Setup.of(problems, limits, options)
    with setup.budget() as budget:
        solve = _Sweep(setup, budget)
        solve.incumbents()
        solve.bounds()
        results = solve.results()
    residuals = None
    if setup.problems[0].weights is not None:
        residuals = list(map(_residual, setup.problems, results))
    return SweepResult(results, [level.proven_by for level in solve.levels], residuals)


def _residual(problem: Problem, result: Result) -> float:
    """Return the RMS residual of the returned pairs, without weights."""
    rows, columns = result.assignment.T
    moved = apply_pose(result.T_target_source, problem.source[rows])
    return float(np.sqrt(((moved - problem.target[columns]) ** 2).sum(axis=1).mean()))


@dataclass
class Level:
    """One cardinality: its problem, its search and its bounds, in normalised units."""

    at: int
    name: int  # the cardinality as given
    attempt: Attempt
    theta: np.ndarray = field(default_factory=lambda: np.empty(0))
    lower_bound: float = 0.0
    upper_bound: float = np.inf
    proven_by: int | None = None
    stopped_by: Status | None = None
    n_descending: int = 0
    descending_s: float = 0.0
    tried: list[np.ndarray] = field(default_factory=list)  # poses of other cardinalities
    events: list[Event] = field(default_factory=list)
    searches: list[Stage] = field(default_factory=list)

    @classmethod
    def of(cls, setup: Setup, at: int, budget: Budget) -> Level:
        """Prepare the search for ``setup.problems[at]``, without a cover."""
        name = setup.problems[at].n_inliers
        mode = replace(setup.mode, stage=f"k={name}", make_cover=None)
        return cls(at, name, Attempt(mode, setup.normalised(at, budget)))

    @property
    def normalised(self) -> NormalisedProblem:
        return self.attempt.problem

    @property
    def space(self) -> Any:
        return self.attempt.space

    @property
    def k(self) -> int:
        """Number of pairs in the search."""
        return self.normalised.n_inliers

    @property
    def tolerance(self) -> Tolerance:
        return self.normalised.tolerance

    @property
    def status(self) -> Status | None:
        """The status if the gap is closed, else None."""
        return self.tolerance.status(self.lower_bound, self.upper_bound)

    def take(self, theta: np.ndarray, value: float, spent: int = 0) -> None:
        """Keep the pose if it is better than the present one."""
        self.n_descending += spent
        if value < self.upper_bound or not self.theta.size:
            self.theta, self.upper_bound = theta, value

    def inherit(self, smaller: Level) -> None:
        """Transfer the lower bound of a smaller cardinality."""
        bound = self.k / smaller.k * smaller.lower_bound
        if bound > self.lower_bound:
            self.lower_bound, self.proven_by = bound, smaller.proven_by

    def solution(self) -> Solution:
        """Return all that is known except the pose."""
        status = self.status or self.stopped_by or Status.STOPPED
        local = Stage("local searches", self.descending_s, n_assignments=self.n_descending)
        return Solution(
            np.empty(0), status, self.lower_bound, self.upper_bound, self.space.scope,
            [local, *self.searches], list(self.events),
        )  # fmt: skip


class _Sweep:
    """The state of one sweep; its methods are the stages, in the order of their calls."""

    def __init__(self, setup: Setup, budget: Budget) -> None:
        self.setup, self.mode, self.budget = setup, setup.mode, budget
        self.searching = budget.isolated_sub_budget(self._searching_share())
        self.levels = [Level.of(setup, at, self.searching) for at in range(len(setup.problems))]
        self.rotation: np.ndarray | None = None  # of the last translation

    def _searching_share(self) -> float:
        """Share of the time for the search; the rest is for recovering and matching the poses."""
        share = search_share(self.mode)
        if self.setup.is_sampled:
            share *= SEARCH_SHARE
        limit = self.budget.left()
        if not limit:
            return share
        clouds = self.setup.problems[0]
        points = max(len(clouds.source), len(clouds.target))
        ending = len(self.setup.problems) * points * _ENDING_S_PER_POINT / limit
        return min(share, 1.0 - min(ending, _LARGEST_ENDING))

    def incumbents(self) -> None:
        """Find a pose for every cardinality, by local searches and from its neighbours."""
        starting = self.searching.sub_budget(STARTING_SHARE)
        for at, level in enumerate(self.levels):
            if at and starting.is_over:
                self._offer(self.levels[at - 1].theta, level)
                continue
            began = self.budget.elapsed()
            own = starting.sub_budget(1.0 / (len(self.levels) - at))
            named = own.named(f"start of k={level.name}")
            start = level.attempt.start(named)
            level.take(start.theta, start.value, start.n_assignments)
            level.descending_s += self.budget.elapsed() - began
        self._exchange()

    def _exchange(self) -> None:
        """Try every pose at its neighbours, smaller ones last: U_k / k is then ascending."""
        upward = list(itertools.pairwise(self.levels))
        downward = [(b, a) for a, b in reversed(upward)]
        for giver, taker in upward + downward:
            self._offer(giver.theta, taker)

    def _offer(self, theta: np.ndarray, taker: Level) -> None:
        """Try a pose of another cardinality, refined if there is time for it."""
        if any(theta is known for known in (taker.theta, *taker.tried)):
            return
        began = self.budget.elapsed()
        taker.tried.append(theta)
        if not taker.theta.size:
            taker.take(theta, np.inf)
        with suppress(Interrupted):
            if not self.searching.is_over:
                taker.take(*taker.space.refine(theta))
        with suppress(Interrupted):
            if self.searching.is_over:
                value, _ = taker.space.with_stop_flag(self.budget.hard_stop).objective(theta)
                taker.take(theta, value, 1)
        taker.descending_s += self.budget.elapsed() - began

    def bounds(self) -> None:
        """Prove the cardinalities in ascending order, each by transfer if that suffices."""
        for at, level in enumerate(self.levels):
            if at:
                level.inherit(self.levels[at - 1])
            if level.status is not None:
                continue
            if self.searching.is_over:
                level.stopped_by = self.searching.ended_by
                continue
            run, tolerance = self._run(at)
            n_open = sum(other.status is None for other in self.levels[at:])
            self._search(level, tolerance, self.searching.sub_budget(run / n_open))

    def _run(self, at: int) -> tuple[int, Tolerance]:
        """Return how many levels from `at` on one search can prove, and the tolerance it needs."""
        level = self.levels[at]
        own = level.tolerance.allowed(level.upper_bound)
        count, gap = 1, own
        for other in self.levels[at + 1 :]:
            needed = level.k / other.k * other.tolerance.cutoff(other.upper_bound)
            # rounding of the division must not prevent the transfer from closing the gap
            wanted = min(gap, (level.upper_bound - needed) * (1.0 - 1e-6))
            if wanted < TIGHTEST_SHARE * own:
                break
            count, gap = count + 1, wanted
        return count, level.tolerance.tightened(gap / own)

    def _search(self, level: Level, tolerance: Tolerance, budget: Budget) -> None:
        # a proof about a sample says little about all points, which need the time
        patience_s = level.normalised.patience_s if self.setup.is_sampled else None
        attempt = replace(level.attempt, problem=replace(level.normalised, tolerance=tolerance))
        start = Start(level.theta, level.upper_bound)
        for tried, found in attempts(attempt, budget.with_patience(patience_s), start):
            stage = "search" if tried is attempt else tried.mode.stage
            level.searches.append(Stage.of(stage, found, tolerance.allowed(found.upper_bound)))
            level.events += found.events
        better = found.upper_bound < level.upper_bound
        level.take(found.theta, found.upper_bound)
        if found.lower_bound > level.lower_bound:
            level.lower_bound, level.proven_by = found.lower_bound, level.name
        level.stopped_by = found.status
        if better:
            self._exchange()

    def results(self) -> list[Result]:
        """Return the results, each with an equal share of the remaining time.

        The largest cardinality comes first: its cheapest pairs are candidates for the others.
        """
        found: list[Result] = []
        known: Matched | None = None
        for n_left in range(len(self.levels), 0, -1):
            budget = self.budget.isolated_sub_budget(1.0 / n_left)
            found.insert(0, self._result(self.levels[n_left - 1], budget, known))
            last = found[0]
            known = Matched(last.T_target_source, last.assignment, last.is_greedy)
        return found

    def _result(self, level: Level, budget: Budget, known: Matched | None) -> Result:
        began = budget.elapsed()
        placing = budget.sub_budget(SEARCH_SHARE) if self.setup.is_sampled else budget
        solution = level.solution()
        spent = sum(stage.time_s for stage in solution.stages)
        self._recover_pose(level, placing, solution)
        finish = Finish(self.setup, level.at, level.normalised, budget, placing, known)
        return replace(finish.result(solution), time_solve_s=spent + budget.elapsed() - began)

    def _recover_pose(self, level: Level, budget: Budget, solution: Solution) -> None:
        """Recover the pose; past the limit the rotation of another cardinality replaces a search."""
        if self.rotation is None or not budget.is_over:
            recover_pose(self.mode, level.normalised, level.space, level.theta, budget, solution)
        else:
            solution.T = shifted_rotation(self.rotation, level.theta)
            if solution.status in (Status.OPTIMAL, Status.CONVERGED):
                solution.status = budget.ended_by
        if self.mode.rotation is not None:
            self.rotation = solution.T[:3, :3]
