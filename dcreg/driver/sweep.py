"""`sweep`: the optimum for several cardinalities, to choose from when `n_inliers` is not known.

Let E_k(theta) be the least sum of squared residuals of k one-to-one pairs at a pose. Of an optimal
matching of k' > k pairs the k cheapest cost at most the share k / k', and they are a k-matching, so

    E_k(theta) / k <= E_k'(theta) / k'   for every theta, and so for the minima over theta.

A lower bound for k, times k' / k, is thus one for k' (*transfer*). A search for k that ends a little
below its own tolerance often proves a whole run of larger cardinalities: with U and eps their upper
bounds and tolerances, it is enough that

    lower_bound_k >= (k / k') (U_k' - eps_k')   for every k' of the run,

which asks of the search only a gap of U_k less the greatest right side. While the points added fit
as well as those before, the bounds per pair hardly move and one search serves many cardinalities;
where outliers come in, every cardinality has its own search, over its own (smaller) start box.

Poses travel both ways: the best one for k, refined, is tried for the neighbours of k; as it is where
the time is over. Results are made from the most pairs down: their pairs and poses are tried for fewer.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from dcreg.assignment.objective import Matched
from dcreg.driver.downsample import SEARCH_SHARE
from dcreg.driver.modes import shifted_rotation
from dcreg.driver.normalised import Solution
from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.solve import Finish, Setup
from dcreg.driver.sweep_level import Level
from dcreg.problem import InputError, Problem
from dcreg.result import Result, Stage
from dcreg.search import Budget, Interrupted, minimise
from dcreg.status import Status
from dcreg.sweep_result import SweepResult

# A search may be asked for this share of its own tolerance to prove larger cardinalities as well;
# with less, the one search costs more than those it saves.
TIGHTEST_SHARE = 0.5
# Of the time, for the descents of all cardinalities together: none goes without.
STARTING_SHARE = 0.5
# What it takes to match all points at a pose, roughly: kept free for every cardinality, though no
# more than this share of the time.
_ENDING_S_PER_POINT = 5e-6
_LARGEST_ENDING = 0.75


def sweep_problems(
    problems: Sequence[Problem], limits: Limits, options: SolveOptions
) -> SweepResult:
    """Solve problems that differ in `n_inliers`, given in ascending order; see `dcreg.sweep`."""
    if options.certificate:
        raise InputError("certificate: a sweep keeps none; use register for one cardinality")
    setup = Setup.of(problems, limits, options)
    with setup.budget() as budget:
        solve = _Sweep(setup, budget)
        solve.incumbents()
        solve.bounds()
        results = solve.results()
    return SweepResult(results, [level.proven_by for level in solve.levels])


class _Sweep:
    """The state of one sweep; its methods are the stages, in the order in which they are called."""

    def __init__(self, setup: Setup, budget: Budget) -> None:
        self.setup, self.mode, self.budget = setup, setup.mode, budget
        self.searching = budget.isolated_sub_budget(self._searching_share())
        self.levels = [Level.of(setup, at, self.searching) for at in range(len(setup.problems))]
        self.rotation: np.ndarray | None = None  # that of the last translation

    def _searching_share(self) -> float:
        """Share of the time that is searched: the rest is for placing and matching what was found."""
        share = self.mode.search_share
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
        """A pose for every cardinality, from descents of its own and from its neighbours'."""
        starting = self.searching.sub_budget(STARTING_SHARE)
        for at, level in enumerate(self.levels):
            if at and starting.is_over:
                self._offer(self.levels[at - 1].theta, level)
                continue
            began = self.budget.elapsed()
            own = starting.sub_budget(1.0 / (len(self.levels) - at))
            named = own.named(f"start of k={level.name}")
            level.take(*level.space.start(named, level.gap_tol))
            level.descending_s += self.budget.elapsed() - began
        self._exchange()

    def _exchange(self) -> None:
        """Every pose is tried by its neighbours, last by the smaller ones: U_k / k then ascends."""
        upward = list(itertools.pairwise(self.levels))
        downward = [(b, a) for a, b in reversed(upward)]
        for giver, taker in upward + downward:
            self._offer(giver.theta, taker)

    def _offer(self, theta: np.ndarray, taker: Level) -> None:
        """A pose of another cardinality, refined; as it is where the time for searching is over."""
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
                value, _ = taker.space.objective(theta, self.budget.hard_stop)
                taker.take(theta, value, 1)
        taker.descending_s += self.budget.elapsed() - began

    def bounds(self) -> None:
        """Prove the cardinalities in ascending order, each by transfer if that is enough."""
        for at, level in enumerate(self.levels):
            if at:
                level.inherit(self.levels[at - 1])
            if level.closed:
                continue
            if self.searching.is_over:
                level.stopped_by = self.searching.ended_by
                continue
            run, gap_tol = self._run(at)
            n_open = sum(not other.closed for other in self.levels[at:])
            self._search(level, gap_tol, self.searching.sub_budget(run / n_open))

    def _run(self, at: int) -> tuple[int, float]:
        """How many levels from `at` on one search can prove, and the gap it needs for that."""
        level = self.levels[at]
        count, gap_tol = 1, level.gap_tol
        for other in self.levels[at + 1 :]:
            needed = level.k / other.k * (other.upper_bound - other.gap_tol)
            # the last digits of the division must not keep the transfer from closing the gap
            wanted = min(gap_tol, (level.upper_bound - needed) * (1.0 - 1e-6))
            if wanted < TIGHTEST_SHARE * level.gap_tol:
                break
            count, gap_tol = count + 1, wanted
        return count, gap_tol

    def _search(self, level: Level, gap_tol: float, budget: Budget) -> None:
        found = minimise(
            level.space, self.mode.bound(level.normalised, level.space), budget,
            gap_tol=gap_tol, start=(level.theta, level.upper_bound), stage=f"k={level.name}",
        )  # fmt: skip
        better = found.upper_bound < level.upper_bound
        level.take(found.theta, found.upper_bound)
        if found.lower_bound > level.lower_bound:
            level.lower_bound, level.proven_by = found.lower_bound, level.name
        level.stopped_by = found.status
        level.events = found.events
        level.searches.append(Stage.of("search", found, gap_tol))
        if better:
            self._exchange()

    def results(self) -> list[Result]:
        """Return the results, each with an equal share of the time that is left.

        The most pairs come first: the cheapest of them may serve for fewer.
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
            self.mode.recover_pose(level.normalised, level.space, level.theta, budget, solution)
        else:
            solution.T = shifted_rotation(self.rotation, level.theta)
            if solution.status is Status.OPTIMAL:
                solution.status = budget.ended_by
        if self.mode.rotation is not None:
            self.rotation = solution.T[:3, :3]
