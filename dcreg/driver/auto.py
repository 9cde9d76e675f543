"""Choose the number of pairs where none is given, then solve with it.

At the right pose the residuals of true pairs are noise; those of further pairs are as large as the
spacing of the points. The *fractional* RMSE, the RMS residual of the cheapest k pairs divided by a power
of k, therefore has a minimum near the number of true pairs (after Phillips, Liu and Tomasi 2007).

The pose is not known either, but a part of the true pairs suffices to find it. So local searches for few
numbers (`PROBES`) give poses. From each pose, its best number and the best pose for this number
alternate. A smaller power of k compares the poses, and the local minima of each. The best pose gives the
number. It is also the initial guess of the search that follows, which is that of `dcreg.register` with
this number. No step of the choice is proven.

Few pairs of small clouds nearly always fit well. There, the expected number of fits as good by chance
compares the poses.

The residuals are those of one-to-one pairs, or, for many points, the distances of source points to their
nearest target points.
"""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np

from dcreg import text
from dcreg.assignment.objective import objective
from dcreg.assignment.sparse import greedy_count
from dcreg.driver.checks import norms_only
from dcreg.driver.fractional import POWER_OF_NEIGHBOURS, POWER_OF_PAIRS, Fit
from dcreg.driver.modes import choose_mode, find_mode, space_of
from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.solve import Setup, solve
from dcreg.driver.uncertainty import proven_number
from dcreg.families.mode import Mode
from dcreg.names import AUTO
from dcreg.problem import (
    InputError,
    Moments,
    Problem,
    apply_pose,
    exact_objective,
)
from dcreg.problem.chance import log_chance_fits
from dcreg.problem.trees import tree_of
from dcreg.result import Result
from dcreg.result_parts import ChosenNumber, ComparedNumber, Stage
from dcreg.runner_up import DISTINCT
from dcreg.search import Budget, Event, Interrupted

# Shares of the largest possible number of pairs: those with local searches (one for many points, of which
# a search takes longer), and those that are compared.
PROBES, PROBES_OF_MANY = (0.45, 0.3, 0.18), (0.45,)
SHARP = 1.5  # ratio of the next fractional RMSE to the best one; above, the last probe is left out
SMALLEST_SHARE, SHARE_STEP = 0.1, 0.1
MANY_POINTS = 64  # of the smaller cloud, from which few pairs hardly fit by chance
MANY_PAIRS = 40_000  # point pairs from which nearest distances replace one-to-one pairs
MAX_NUMBERS = 400  # among which the choice is made
MAX_BETWEEN = 40  # numbers tried between the neighbours of the best one
MAX_POSES = 3  # of a probe that are followed
# RMS displacement of the source from which poses differ, in RMS radii of the target.
DISTINCT_POSES = 0.1
MAX_ROUNDS = 8  # of the alternation
MAX_POINTS = 2000  # source points whose nearest distances are compared
TIME_SHARE = 0.4  # of the time limit
NEARLY = 1.1  # fractional RMSE of what fits nearly as well, divided by the minimum
UNCERTAIN = 1.5  # ratio of the largest to the smallest such number that makes the choice uncertain
STAGE = "n_inliers"
_REMEDY = "Give n_inliers if you know it, or look at the curves of `dcreg sweep`"


def register_auto(problem: Problem, limits: Limits, options: SolveOptions) -> Result:
    """Choose the number of pairs and solve, see `dcreg.register`; that of `problem` does not matter."""
    if limits.max_rms is not None:
        raise InputError(
            "n_inliers: max_rms needs a number of pairs; give one, or find the largest possible number "
            "with max_inliers (`dcreg max-inliers`)"
        )
    if options.checkpoint is not None:
        raise InputError(
            "n_inliers: checkpoint needs a number of pairs; run once without checkpoint, and give the "
            "number that the result states"
        )
    name = None if options.mode == AUTO else options.mode
    if options.bound is not None or options.certificate:
        name = name or choose_mode(problem, options.bound, options.certificate)
    if name is not None and options.downsample is None:  # before kernels are compiled
        _check(find_mode(problem.model, name), problem, options.bound)
    setup = Setup.of(_problems(problem), limits, options)
    _check(setup.mode, setup.searched[-1], options.bound)
    is_many = setup.is_sampled or len(problem.source) * len(problem.target) > MANY_PAIRS
    kind = _ByNeighbours if is_many and problem.candidates is None else _ByPairs
    with setup.budget() as budget:
        choice = kind(setup, budget.isolated_sub_budget(TIME_SHARE).silent())
        at, chosen, pose = choice.run()
        chosen_s = budget.elapsed()
        result = solve(setup, at, budget, init=pose)
        clouds = problem.source, problem.target
        stage = Stage(STAGE, chosen_s, n_assignments=choice.n_assignments)
        return replace(
            result,
            chosen_number=replace(chosen, proven=proven_number(result, *clouds)),
            stages=[stage, *result.stages],
            n_assignments=result.n_assignments + choice.n_assignments,
            warnings=[
                *choice_warnings(result.n_inliers, chosen, setup.problems),
                *_left_pose(choice, pose, result),
                *few_sampled_pairs(result),
                *result.warnings,
            ],
        )


def _check(mode: Mode, problem: Problem, bound: str | None) -> None:
    """Refuse a mode that knows no poses."""
    if mode.in_norm_space:
        raise InputError(
            "n_inliers: the library chooses it by a search over poses; give a number, or change this: "
            + norms_only(mode, problem, bound=bound)
        )


def _problems(problem: Problem) -> list[Problem]:
    """Return the problem for all numbers among which the choice is made, in ascending order."""
    most = problem.max_n_inliers
    least = min(most, max(problem.dim, round(SMALLEST_SHARE * most)))
    numbers = np.unique(np.linspace(least, most, MAX_NUMBERS).round().astype(int))
    largest = problem.with_n_inliers(most)
    return [largest.with_n_inliers(int(k)) for k in numbers]


def choice_warnings(
    n_inliers: int, chosen: ChosenNumber, problems: Sequence[Problem]
) -> Iterator[str]:
    """Yield a warning where the evidence for a number of pairs is weak."""
    if not chosen.compared:
        yield (
            "no numbers of pairs were compared before the search was stopped or the time was over, so "
            f"n_inliers={n_inliers} is a guess. {_REMEDY}"
        )
    elif n_inliers == problems[0].n_inliers < problems[-1].n_inliers:
        yield f"n_inliers={n_inliers} is the smallest number that was compared. {_REMEDY}"
    elif chosen.high > UNCERTAIN * chosen.low:
        yield (
            f"n_inliers={n_inliers} is uncertain: from {chosen.low} to {chosen.high} pairs, the "
            f"residuals do not increase sharply. {_REMEDY}"
        )
    if chosen.compared and chosen.is_cut:
        yield (
            f"n_inliers={n_inliers} is uncertain: the search was stopped or the time for the choice, "
            f"{TIME_SHARE:.0%} of the time limit, was over before all poses and numbers were compared. "
            f"Allow more time. {_REMEDY}"
        )
    other = chosen.runner_up
    if other is not None and not chosen.low <= other <= chosen.high:
        yield (
            f"n_inliers={n_inliers} is uncertain: at another pose, {other} pairs fit nearly as well. "
            f"{_REMEDY}"
        )


def _left_pose(choice: _Choice, pose: np.ndarray | None, result: Result) -> Iterator[str]:
    """Yield a warning if the search left the pose at which the number was chosen."""
    if pose is not None and choice.is_distinct(pose, result.T_target_source):
        yield (
            f"n_inliers={result.n_inliers} was chosen at a clearly different pose, which the search then "
            f"left for a better one. {_REMEDY}"
        )


def few_sampled_pairs(result: Result) -> Iterator[str]:
    """Yield a warning if the pairs of the sample determine no pose, so that its bounds mean little."""
    sample, dim = result.downsampled, len(result.translation)
    if sample is not None and sample.n_inliers <= dim and sample.n_inliers < result.n_inliers:
        yield (
            f"the sample has only {text.count(sample.n_inliers, 'pair')} of {result.n_inliers}, which "
            "fit at many poses: the bounds say nothing about this pose. Search a larger sample "
            "(downsample, or --downsample)"
        )


class _Choice(abc.ABC):
    """The search for the number of pairs; all poses are those of the input.

    Attributes
    ----------
    n_assignments : int
    """

    probes: Sequence[float]

    def __init__(self, setup: Setup, budget: Budget) -> None:
        self.setup, self.budget, self.problem = setup, budget, setup.problems[-1]
        clouds = self.problem.source, self.problem.target
        most = self.problem.n_inliers
        self.rounding = float(np.sqrt(exact_objective(*clouds, most) / most))
        self.numbers = np.array([problem.n_inliers for problem in setup.problems])
        self.n_assignments = 0
        self.fits: list[Fit] = []

    def nearest(self, shares: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the indices of the numbers nearest to shares of the largest one."""
        wanted = self.numbers[-1] * np.asarray(shares)
        return np.unique(np.abs(self.numbers - wanted[:, None]).argmin(axis=1))

    def run(self) -> tuple[int, ChosenNumber, np.ndarray | None]:
        """Return the index of the number among the problems, the evidence for it, and its pose."""
        self.budget.report(Event("heartbeat", STAGE, self.budget.elapsed(), 0, 0, 0, 0.0, np.inf))
        fits = self.fits
        with suppress(Interrupted):
            for pose in self._poses():
                fits.append(self._followed(pose))
        if not fits:
            at = int(self.nearest([0.5])[0])
            low, high = self.numbers[[0, -1]].tolist()
            return at, ChosenNumber([], low, high, is_cut=True), None
        fit = min(fits, key=lambda each: each.value)
        wanted, share = self.number(fit)
        at = int(np.abs(self.numbers - wanted).argmin())
        chosen = int(self.numbers[at])
        compared = [
            ComparedNumber(min(int(self.numbers[-1]), round(share * number)), float(rms))
            for number, rms in zip(fit.numbers.tolist(), fit.rms, strict=True)
        ]
        # the run of numbers around the best one that fit nearly as well
        others = np.flatnonzero(fit.fractional > NEARLY * fit.fractional[fit.best])
        first = others[others < fit.best].max(initial=-1) + 1
        last = others[others > fit.best].min(initial=len(compared)) - 1
        low, high = min(chosen, compared[first].n_inliers), max(chosen, compared[last].n_inliers)
        # many neighbours can exceed the largest possible number of pairs; it is listed once
        distinct = list({each.n_inliers: each for each in reversed(compared)}.values())[::-1]
        runner_up = self._runner_up(fit, fits)
        return at, ChosenNumber(distinct, low, high, runner_up, self.budget.is_over), fit.pose

    def _runner_up(self, fit: Fit, fits: Sequence[Fit]) -> int | None:
        """Return the number of pairs of a clearly different pose that is nearly as good, or None."""
        others = [each for each in fits if self.is_distinct(each.pose, fit.pose)]
        other = min(others, key=lambda each: each.value, default=None)
        if other is None or other.value > NEARLY * max(fit.value, np.finfo(float).tiny):
            return None
        return min(int(self.numbers[-1]), round(self.number(other)[0]))

    def is_distinct(self, one: np.ndarray, other: np.ndarray) -> bool:
        """Tell whether two poses clearly differ, by how far apart they bring the source."""
        apart = Moments.of(self.problem.source).displacement(one, other)
        return bool(apart > DISTINCT * self.setup.frame.unit)

    def _poses(self) -> Iterator[np.ndarray]:
        """Yield poses to be followed: the initial guess, and the ends of local searches."""
        setup = self.setup
        if setup.options.init is not None:
            yield setup.options.init
        moments, apart = Moments.of(self.problem.source), DISTINCT_POSES * setup.frame.unit
        probes = self.nearest(self.probes)[::-1].tolist()
        for n_left, at in zip(range(len(probes), 0, -1), probes, strict=True):
            if self.budget.is_over or (n_left == 1 and self._is_sharp()):
                return
            normalised = setup.normalised(at, self.budget)
            space = space_of(setup.mode, normalised)
            part = self.budget.sub_budget(1.0 / n_left)
            self.n_assignments += space.start(part, normalised.tolerance.enough)[2]
            kept: list[np.ndarray] = []
            for theta, _ in sorted(space.ends, key=itemgetter(1)):
                pose = setup.frame.pose(space.pose(theta))
                if all(moments.displacement(pose, other) > apart for other in kept):
                    kept.append(pose)
                    yield pose
                if len(kept) == MAX_POSES:
                    break

    def _is_sharp(self) -> bool:
        """Tell whether the residuals increase sharply behind the best number of several."""
        fit = min(self.fits, key=lambda each: each.value, default=None)
        if fit is None or len(self.probes) == 1 or fit.best + 1 == len(fit.numbers):
            return False
        return bool(fit.fractional[fit.best + 1] > SHARP * fit.fractional[fit.best])

    def _followed(self, pose: np.ndarray) -> Fit:
        """Alternate the best number at a pose and the best pose for it while the value falls."""
        best = self.fit(pose)
        for _ in range(MAX_ROUNDS):
            trial = self.fit(self.refined(best))
            if trial.value >= best.value:
                break
            best = trial
        return best

    @abc.abstractmethod
    def fit(self, pose: np.ndarray) -> Fit:
        """Compare the numbers at a pose."""

    @abc.abstractmethod
    def refined(self, fit: Fit) -> np.ndarray:
        """Return a better pose for the best number."""

    @abc.abstractmethod
    def number(self, fit: Fit) -> tuple[float, float]:
        """Return the number of pairs, and the number of pairs for one of the numbers compared."""


class _ByPairs(_Choice):
    """Compare the residuals of one-to-one pairs."""

    probes = PROBES

    def __init__(self, setup: Setup, budget: Budget) -> None:
        super().__init__(setup, budget)
        shares = np.arange(SMALLEST_SHARE, 1.0, SHARE_STEP)
        self.grid = np.unique(np.append(self.nearest(shares), [0, len(self.numbers) - 1]))
        normalised = [setup.normalised(at, budget) for at in self.grid.tolist()]
        self.spaces: list[Any] = [space_of(setup.mode, each) for each in normalised]

    def fit(self, pose: np.ndarray) -> Fit:
        theta = self.spaces[0].parameter(self.setup.frame.normalised_pose(pose))
        values = np.array([space.objective(theta)[0] for space in self.spaces])
        self.n_assignments += len(values)
        k = self.numbers[self.grid]
        rms = self.setup.frame.unit * np.sqrt(np.maximum(values, 0.0) / k)
        return self._fit(pose, k, rms)

    def refined(self, fit: Fit) -> np.ndarray:
        frame, space = self.setup.frame, self.spaces[fit.best]
        theta, _, spent = space.refine(space.parameter(frame.normalised_pose(fit.pose)))
        self.n_assignments += spent
        return frame.pose(space.pose(theta))

    def number(self, fit: Fit) -> tuple[float, float]:
        """Return the best number between the neighbours of the best one of those compared."""
        low, high = (
            self.grid[max(0, fit.best - 1)],
            self.grid[min(len(self.grid) - 1, fit.best + 1)],
        )
        rows = np.unique(np.linspace(low, high, MAX_BETWEEN).round().astype(int))
        problem, k = self.problem, self.numbers[rows]
        clouds = problem.source, problem.target
        # the cheapest pairs of a larger optimal matching are not those of a smaller one
        values: list[float] = []
        for n in k:
            if values and self.budget.is_over:
                break
            values.append(objective(*clouds, fit.pose, int(n), problem.candidates)[0])
        self.n_assignments += len(values)
        k = k[: len(values)]
        rms = np.sqrt(np.maximum(values, 0.0) / k)
        return float(k[self._fit(fit.pose, k, rms).best]), 1.0

    def _fit(self, pose: np.ndarray, k: np.ndarray, rms: np.ndarray) -> Fit:
        """Return the fit of these residuals; below the rounding error, all are equally good."""
        rms, problem = np.maximum(rms, self.rounding), self.problem
        values = None
        if min(len(problem.source), len(problem.target)) < MANY_POINTS:
            chance = [
                log_chance_fits(problem, *each) for each in zip(k.tolist(), k * rms**2, strict=True)
            ]
            # the ratio of two values of all pairs is that of their residuals
            values = np.exp(np.array(chance) / (problem.dim * problem.n_inliers))
        return Fit.of(pose, k, rms, POWER_OF_PAIRS, values)


class _ByNeighbours(_Choice):
    """Compare the distances of source points to their nearest target points."""

    probes = PROBES_OF_MANY

    def __init__(self, setup: Setup, budget: Budget) -> None:
        super().__init__(setup, budget)
        source = self.problem.source
        rows = np.random.default_rng(0).permutation(len(source))[:MAX_POINTS]
        self.some, self.tree = source[np.sort(rows)], tree_of(self.problem.target)
        shares = np.arange(SMALLEST_SHARE, 1.0 + 0.25 * SHARE_STEP, 0.5 * SHARE_STEP)
        self.grid = np.unique(np.maximum(1, (shares * len(self.some)).round().astype(int)))

    def fit(self, pose: np.ndarray) -> Fit:
        if self.budget.is_over:
            raise Interrupted
        squares = np.sort(self.tree.nearest(apply_pose(pose, self.some))[0] ** 2)
        rms = np.sqrt(np.cumsum(squares)[self.grid - 1] / self.grid)
        return Fit.of(pose, self.grid, np.maximum(rms, self.rounding), POWER_OF_NEIGHBOURS)

    def refined(self, fit: Fit) -> np.ndarray:
        distances, columns = self.tree.nearest(apply_pose(fit.pose, self.some))
        rows = np.argsort(distances, kind="stable")[: self.grid[fit.best]]
        return self.problem.fit(self.some[rows], self.problem.target[columns[rows]])

    def number(self, fit: Fit) -> tuple[float, float]:
        """Return how many one-to-one pairs are as near as the best number of neighbours."""
        distances = np.sort(self.tree.nearest(apply_pose(fit.pose, self.some))[0])
        near = self.grid[fit.best]
        moved = apply_pose(fit.pose, self.problem.source)
        count = greedy_count(moved, self.tree, max(distances[near - 1], self.rounding))
        return float(count), count / float(near)
