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
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from dcreg.assignment.polish import objective
from dcreg.assignment.reuse import Matched, quick_objective
from dcreg.driver.downsample import SEARCH_SHARE, to_search
from dcreg.driver.modes import CHOSEN, Mode, choose_mode, find_mode
from dcreg.driver.options import SolveOptions
from dcreg.driver.paper import TRANSLATION_SHARE, place, pose_of
from dcreg.driver.solve import advise, check_settings, completed, in_file_units, result_of
from dcreg.driver.sweep_level import Level
from dcreg.driver.task import Answer, Task
from dcreg.driver.warm_up import special, warm_up_mode
from dcreg.families.protocol import Space
from dcreg.families.registry import make_bound
from dcreg.names import AUTO, DEFAULT_TIME_LIMIT_S, mode_names
from dcreg.problem import Candidates, Frame, InputError, Problem, gap_tol_of
from dcreg.result import Result, Stage
from dcreg.search import Budget, Interrupted, Outcome, minimise
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


def sweep(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: Sequence[int | float],
    *,
    model: str,
    scale_range: tuple[float, float] | None = None,
    candidates: Candidates | None = None,
    gap_tol: float | None = None,
    tol: float | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    node_limit: int | None = None,
    memory_limit_mb: float | None = None,
    options: SolveOptions | None = None,
) -> SweepResult:
    """Register two clouds for several numbers of inliers, with bounds for each.

    For every cardinality the problem of `dcreg.register` is solved; searches share
    their poses, and a bound for fewer pairs serves for more of them where it is good enough. The k
    cheapest pairs of a feasible matching are feasible, so `candidates` change nothing about that.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
    n_inliers : sequence of int or float
        Cardinalities, in any order and with repetitions; floats in (0, 1] are fractions of
        ``min(n, m)``.
    model, scale_range, candidates
        As in `dcreg.register`.
    gap_tol : float, optional
        Absolute tolerance for every cardinality; default `dcreg.default_gap_tol` of each.
    tol : float, optional
        A length instead, as in `dcreg.register`: ``gap_tol = k * tol^2`` for cardinality k.
    time_limit : float, optional
        Seconds for all cardinalities, 60 unless told otherwise; None or inf: no limit. What one
        leaves over goes to those after it; those whose gap is open at the end have status
        ``time_limit``, with valid bounds and a pose.
    node_limit, memory_limit_mb : optional
        For each search.
    options : SolveOptions, optional
        As in `dcreg.register`, but a sweep keeps no certificate. The stages of events name the
        cardinality (``k=40``) or are ``rotation``. Cardinalities that are the same number of pairs after
        downsampling have the same bounds.

    Returns
    -------
    SweepResult

    Raises
    ------
    InputError
        For bad input, before any search, naming field, value and remedy.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> rng = np.random.default_rng(0)
    >>> points = rng.random((20, 2))
    >>> moved = points + 3.0 + 0.01 * rng.standard_normal((20, 2))
    >>> moved[16:] = rng.random((4, 2)) + 3.0  # outliers
    >>> found = dcreg.sweep(points, moved, [12, 14, 16, 18, 20], model="similarity2d")
    >>> found.status.value, [round(row["rms"], 2) for row in found.rows()]
    ('optimal', [0.01, 0.01, 0.01, 0.03, 0.11])
    """
    began = time.perf_counter()
    problems = _problems(source, target, n_inliers, model, scale_range, candidates)
    options = options or SolveOptions()
    if options.certificate:
        raise InputError("certificate: a sweep keeps none; use register for one cardinality")
    bound, threads = options.bound, options.threads
    asked = None if options.mode == AUTO else options.mode
    searched = to_search(problems, options.downsample, asked, bound)
    way = _mode(searched[-1], asked, bound)
    way.check(searched[-1], bound, certificate=False)
    gap_tols = [gap_tol_of(tol, gap_tol, problem.n_inliers) for problem in searched]
    check_settings(
        gap_tol=gap_tols[-1], time_limit=time_limit, node_limit=node_limit,
        memory_limit_mb=memory_limit_mb, threads=threads,
    )  # fmt: skip
    advise(searched[-1])
    warm_up_mode(way, bound, *special(searched[0]))
    time_setup = time.perf_counter() - began
    area = Frame.of(searched[0]).area
    budget = Budget(time_limit, node_limit, memory_limit_mb, in_file_units(options.listener, area))
    with budget:
        searching = budget.isolated_sub_budget(_searching_share(problems, searched, way, budget))
        solve = _Sweep(
            [
                Level.of(whole, problem, way, bound, gap_tol, threads, searching)
                for whole, problem, gap_tol in zip(problems, searched, gap_tols, strict=True)
            ],
            way,
            budget,
            searching,
        )
        solve.incumbents()
        solve.bounds()
        results = solve.results(options.polish, time_setup)
    return SweepResult(results, [level.proven_by for level in solve.levels])


def _mode(problem: Problem, name: str | None, bound: str | None) -> Mode:
    if name is None:
        name = choose_mode(problem, bound)
    if name not in CHOSEN and name in mode_names(problem.model):
        raise InputError(
            f"mode: {name!r} serves one cardinality; a sweep takes {' or '.join(CHOSEN)}"
        )
    return find_mode(problem.model, name)


def _problems(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: Sequence[int | float],
    model: str,
    scale_range: tuple[float, float] | None,
    candidates: Candidates | None,
) -> list[Problem]:
    """One problem per distinct cardinality, ascending."""
    if isinstance(n_inliers, str) or not isinstance(n_inliers, Iterable):
        raise InputError(
            f"n_inliers: {n_inliers!r} is not a list; give several such as [0.5, 0.7, 0.9], or use "
            "register for one"
        )
    made = {
        problem.n_inliers: problem
        for problem in (
            Problem(source, target, k, model, scale_range, candidates) for k in n_inliers
        )
    }
    if not made:
        raise InputError("n_inliers: the list is empty; give at least one count or fraction")
    return [made[k] for k in sorted(made)]


def _searching_share(
    problems: Sequence[Problem], searched: Sequence[Problem], mode: Mode, budget: Budget
) -> float:
    """Share of the time that is searched: the rest is for placing and matching what was found."""
    share = TRANSLATION_SHARE if mode.in_norm_space else 1.0
    if searched[0] is not problems[0]:
        share *= SEARCH_SHARE
    limit = budget.left()
    if not limit:
        return share
    points = max(len(problems[0].source), len(problems[0].target))
    ending = len(problems) * points * _ENDING_S_PER_POINT / limit
    return min(share, 1.0 - min(ending, _LARGEST_ENDING))


class _Sweep:
    """The state of one sweep; its methods are the stages, in the order in which they are called."""

    def __init__(self, levels: list[Level], mode: Mode, budget: Budget, searching: Budget) -> None:
        self.levels, self.mode, self.budget, self.searching = levels, mode, budget, searching
        self.rotation: np.ndarray | None = None  # that of the last translation

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
        space, threads = level.space, level.task.threads
        found: Outcome = minimise(
            space,
            make_bound(level.task.bound, space, threads=threads),
            budget,
            gap_tol=gap_tol,
            start=(level.theta, level.upper_bound),
            stage=f"k={level.name}",
        )
        better = found.upper_bound < level.upper_bound
        level.take(found.theta, found.upper_bound)
        if found.lower_bound > level.lower_bound:
            level.lower_bound, level.proven_by = found.lower_bound, level.name
        level.stopped_by = found.status
        level.events = found.events
        level.searches.append(Stage.of("search", found, gap_tol))
        if better:
            self._exchange()

    def results(self, polish: bool, time_setup: float) -> list[Result]:
        """Poses and results, each with an equal share of the time that is left.

        The most pairs come first: the cheapest of them may serve for fewer.
        """
        found: list[Result] = []
        known: Matched | None = None
        for n_left in range(len(self.levels), 0, -1):
            budget = self.budget.isolated_sub_budget(1.0 / n_left)
            level = self.levels[n_left - 1]
            found.insert(0, self._result(level, polish, time_setup, budget, known))
            last = found[0]
            known = Matched(last.T_target_source, last.assignment, last.is_greedy)
        return found

    def _result(
        self,
        level: Level,
        polish: bool,
        time_setup: float,
        budget: Budget,
        known: Matched | None,
    ) -> Result:
        began = budget.elapsed()
        placing = budget.sub_budget(SEARCH_SHARE) if level.is_sampled else budget
        answer = level.answer()
        spent = sum(stage.time_s for stage in answer.stages)
        self._place(level.task, level.space, level.theta, placing, answer)
        result = result_of(
            level.problem, self.mode, level.task, answer, polish=polish, time_setup_s=time_setup,
            budget=placing, matched=_matched(level, answer.T, polish, placing, known),
        )  # fmt: skip
        result = completed(result, level.whole, level.problem, self.mode, budget, known)
        return replace(result, time_solve_s=spent + budget.elapsed() - began)

    def _place(
        self, task: Task, space: Space, theta: np.ndarray, budget: Budget, answer: Answer
    ) -> None:
        """`place`; past the limit the rotation of another cardinality stands in for a search."""
        if space.fixes_rotation or self.rotation is None or not budget.is_over:
            place(task, space, theta, budget, answer)
        else:
            answer.T = pose_of(self.rotation, theta)
            if answer.status is Status.OPTIMAL:
                answer.status = budget.ended_by
        if not space.fixes_rotation:
            self.rotation = answer.T[:3, :3]


def _matched(
    level: Level, T: np.ndarray, polish: bool, budget: Budget, known: Matched | None
) -> tuple[float, np.ndarray]:
    """Value and pairs at a pose in the frame; pairs of a sample are seen by nobody and may be rough."""
    problem = level.problem
    clouds, T = (problem.source, problem.target), Frame.of(problem).pose(T)
    prove = not (polish or budget.is_over)
    if level.is_sampled:
        return objective(
            *clouds, T, problem.n_inliers, prove=prove, stop=budget.hard_stop, at_once=0
        )
    return quick_objective(
        *clouds,
        T,
        problem.n_inliers,
        problem.candidates,
        known=known,
        prove=prove,
        stop=budget.hard_stop,
    )
