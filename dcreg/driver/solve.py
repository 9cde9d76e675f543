"""The one driver: prepare, search, and turn the solution into a result."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dcreg.assignment.objective import Matched, is_large, objective, quick_objective
from dcreg.certificate.format import Certificate
from dcreg.certificate.record import record
from dcreg.diagnostics import Case, advice, warnings_for
from dcreg.driver.checks import check_mode
from dcreg.driver.downsample import (
    ALL_POINTS,
    Pose,
    refine_poses,
    refined,
    share_of_search,
    to_search,
)
from dcreg.driver.first_stages import first_stages
from dcreg.driver.memory import advance_notice, check_memory, estimated_memory, is_large_work
from dcreg.driver.modes import choose_mode, find_mode, run_mode
from dcreg.driver.normalised import NormalisedProblem, Solution, in_input_units
from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.uncertainty import with_uncertainty
from dcreg.driver.warm_up import warm_up_mode, warm_up_region
from dcreg.families.mode import Mode
from dcreg.families.rigid3d.kernels.boxes import FEW_PAIRS
from dcreg.names import AUTO, OF_SAMPLE, START_BOXES
from dcreg.problem import Frame, InputError, Moments, Problem, checked_pose
from dcreg.problem.geometry import exact_objective, last_bits, rounding_error
from dcreg.result import Result, Stage, Trace, with_answer
from dcreg.result_parts import MemoryEstimate
from dcreg.runner_up import DISTINCT, find_runner_up
from dcreg.search import Budget, Event
from dcreg.status import Status

if TYPE_CHECKING:
    from dcreg.driver.checkpoint import CheckpointFile

_LOGGER = logging.getLogger("dcreg")
# Seconds for a proof by default: of all threads together, at least, and of a sample, which says little.
PATIENCE_S, LEAST_PATIENCE_S, SAMPLE_PATIENCE_S = 5.0, 1.0, 0.1


def register_problem(
    problem: Problem, limits: Limits, options: SolveOptions, mode: Mode | None = None
) -> Result:
    """Solve one problem by a mode of the table, or by `mode`; see `dcreg.register`."""
    setup = Setup.of([problem], limits, options, mode)
    with setup.budget() as budget:
        return solve(setup, 0, budget)


def solve(setup: Setup, at: int, budget: Budget, init: np.ndarray | None = None) -> Result:
    """Solve ``setup.problems[at]``; `init` is the initial guess instead of that of the options."""
    searching = budget
    if setup.is_sampled:
        share = share_of_search(setup.problems[at], budget.left())
        searching = budget.isolated_sub_budget(share)
    normalised = setup.normalised(at, searching)
    if init is not None:
        normalised = replace(normalised, init=setup.frame.normalised_pose(init))
    solution = run_mode(setup.mode, normalised)
    solution.events = budget.history
    result = Finish(setup, at, normalised, budget, searching).result(solution)
    return replace(result, time_solve_s=budget.elapsed(), time_earlier_s=budget.earlier_s)


@dataclass(frozen=True)
class Setup:
    """What is decided before a search over problems that differ in `n_inliers` only.

    Attributes
    ----------
    problems : list of Problem
        As given, in ascending order of `n_inliers`.
    searched : list of Problem
        What is searched for each: itself, or a sample of it.
    frame : Frame
        Of the searched clouds, which all problems share.
    mode : Mode
    limits : Limits
    options : SolveOptions
    time_s : float
        Seconds that the decisions took, compilation included.
    memory : MemoryEstimate
    checkpoint : CheckpointFile, optional
        ``options.checkpoint``, opened.
    """

    problems: Sequence[Problem]
    searched: Sequence[Problem]
    frame: Frame
    mode: Mode
    limits: Limits
    options: SolveOptions
    time_s: float
    memory: MemoryEstimate
    checkpoint: CheckpointFile | None = None

    @classmethod
    def of(
        cls,
        problems: Sequence[Problem],
        limits: Limits,
        options: SolveOptions,
        mode: Mode | None = None,
    ) -> Setup:
        """Choose sample and mode, check all settings, log advice and compile the kernels.

        Parameters
        ----------
        problems : sequence of Problem
        limits : Limits
        options : SolveOptions
        mode : Mode, optional
            A mode that no family offers; it compiles its own kernels.

        Raises
        ------
        InputError
        """
        began = time.perf_counter()
        bound, certificate = options.bound, options.certificate
        name = None if options.mode == AUTO else options.mode
        name = name if mode is None else mode.name  # a mode of its own searches all points
        if limits.max_rms is not None and options.downsample is not None:
            raise InputError(
                "downsample: a sample says nothing about max_rms on all points; omit one of the two"
            )
        searched = problems
        if limits.max_rms is None:
            searched = to_search(problems, options.downsample, name, bound, certificate)
        has_init, has_max_rms = options.init is not None, limits.max_rms is not None
        if has_init:
            first = problems[0]
            init = checked_pose("init", options.init, first.dim, has_scale=first.has_scale)
            options = replace(options, init=init)
        largest = searched[-1]
        if name is None:
            name = choose_mode(largest, bound, certificate)
        chosen = mode or find_mode(largest.model, name, bound)
        check_mode(chosen, largest, bound, certificate, has_init=has_init, has_max_rms=has_max_rms)
        limits.check(largest.n_inliers)
        memory = estimated_memory(problems[-1], largest, chosen, bound, len(problems))
        check_memory(memory, problems[-1])
        is_shown = _LOGGER.isEnabledFor(logging.INFO)  # the estimate of the times is measured
        if is_shown and is_large_work(problems[-1], limits.time_s):
            stages = first_stages(problems[-1], largest, chosen)
            _LOGGER.info(advance_notice(memory, limits.time_s, stages))
        checkpoint = None
        if options.checkpoint is not None:
            from dcreg.driver.checkpoint import open_checkpoint  # few searches need it

            checkpoint = open_checkpoint(largest, chosen, limits, options)
        for line in advice(largest):
            _LOGGER.info(line)
        if mode is None:
            for each in (searched[0], largest):  # only the largest one may match all points
                warm_up_mode(chosen, bound, *_special(each))
            if largest.pose_range is not None:
                warm_up_region(chosen)
        frame = Frame.of(largest)
        time_s = time.perf_counter() - began
        return cls(problems, searched, frame, chosen, limits, options, time_s, memory, checkpoint)

    @property
    def is_sampled(self) -> bool:
        """Whether a sample of the points is searched."""
        return self.searched[0] is not self.problems[0]

    def budget(self) -> Budget:
        """Start the clock; the listener receives events in the units of the input."""
        listener = in_input_units(self.options.listener, self.frame.area)
        budget = self.limits.budget(self.options, listener)
        if self.checkpoint is not None:
            self.checkpoint.attach(budget)
        return budget

    def _patience_s(self) -> float | None:
        """Return how long a proof may take; None: until the limit."""
        if self.options.must_prove or not (self.is_sampled or self.mode.name == "full"):
            return None
        if self.is_sampled:
            return SAMPLE_PATIENCE_S
        return max(LEAST_PATIENCE_S, PATIENCE_S / self.options.n_threads)

    def normalised(self, at: int, budget: Budget) -> NormalisedProblem:
        """Return the problem that is searched for ``problems[at]``."""
        problem, mode, options, frame = self.searched[at], self.mode, self.options, self.frame
        source, target, k = problem.source, problem.target, problem.n_inliers
        given = self.problems[at].n_inliers
        errors = rounding_error(source, target, k), exact_value(problem)
        tolerance = self.limits.tolerance(given, *errors, k / given, last_bits(source, target))
        return NormalisedProblem(
            frame.source(source), frame.target(target), k, problem.scale_range, problem.candidates,
            frame, options.bound or mode.own_bound, options.start_box == START_BOXES[0],
            tolerance.scaled(1.0 / frame.area), options.n_threads, budget, options.certificate,
            self._patience_s(), _region(problem, frame),
            None if options.init is None else frame.normalised_pose(options.init),
            None if problem.weights is None else problem.weights.scaled(1.0 / frame.area),
        )  # fmt: skip


@dataclass(frozen=True)
class Finish:
    """From a solution in normalised units to a result: pairs, polish, all points, warnings.

    Attributes
    ----------
    setup : Setup
    at : int
        The problem is ``setup.problems[at]``.
    normalised : NormalisedProblem
    budget : Budget
        Of all that remains to be done.
    placing : Budget
        Of the steps on the points that were searched.
    known : Matched, optional
        Pairs of another cardinality, tried if the time is over.
    """

    setup: Setup
    at: int
    normalised: NormalisedProblem
    budget: Budget
    placing: Budget
    known: Matched | None = None

    def result(self, solution: Solution) -> Result:
        """Return the result for all points, with its warnings."""
        result = self._of_search(solution)
        problem, mode = self.setup.problems[self.at], self.setup.mode
        if self.setup.is_sampled:
            searched = self.setup.searched[self.at]
            self._report_refinement(np.inf)
            initial = self._initial(result.T_target_source)
            result = refined(result, problem, searched, self.budget, self.known, initial)
            self._report_refinement(result.objective)
        result = self._exact(result)
        if result.max_rms is not None:
            result = with_answer(result)
        scope = _scope(problem, solution.scope, is_sample=result.downsampled is not None)
        result = replace(result, certificate_scope=scope)
        if problem.weights is not None:
            cost = problem.weights.attribute_cost(result.assignment)
            result = replace(result, attribute_cost=cost)
        has_scale = problem.has_scale and problem.scale_range[0] < problem.scale_range[1]
        weights = None if problem.weights is None else problem.weights.of(result.assignment)
        result = with_uncertainty(
            result, problem.source, problem.target, weights, has_scale=has_scale,
            pose_range=problem.pose_range,
        )  # fmt: skip
        return replace(result, warnings=warnings_for(Case(problem, result, mode.in_norm_space)))

    def _initial(self, T: np.ndarray) -> list[np.ndarray]:
        """Return the initial poses that compete with `T` on all points: the user's and the search's.

        That of the search is left out if it differs little from the others.
        """
        given, started = self.setup.options.init, self.normalised.init
        poses = [] if given is None else [given]
        if started is not None:
            pose = self.normalised.frame.pose(started)
            moments = Moments.of(self.setup.problems[0].source)
            apart = DISTINCT * self.normalised.frame.unit
            if all(moments.displacement(pose, other) > apart for other in (T, *poses)):
                poses.append(pose)
        return poses

    def _exact(self, result: Result) -> Result:
        """Return an exact fit as optimal on all points: 0 is a lower bound of every sum of squares."""
        problem = self.setup.problems[self.at]
        exact, value = exact_value(problem), result.objective
        is_decided = result.success or result.status is Status.REFUTED
        if value > exact or is_decided or result.certificate is not None:
            return result
        rounding = rounding_error(problem.source, problem.target, problem.n_inliers)
        tolerance = self.setup.limits.tolerance(problem.n_inliers, rounding, exact)
        return replace(
            result, status=Status.OPTIMAL, lower_bound=0.0, upper_bound=value, is_exact=True,
            gap_tol=tolerance.allowed(value), T_certified=result.T_target_source,
            objective_certified=value, downsampled=None,
        )  # fmt: skip

    def _report_refinement(self, objective: float) -> None:
        """Report the objective on all points; it is no bound of the search, so the trace omits it."""
        budget, value = self.budget, objective / self.normalised.frame.area
        budget.report(Event("heartbeat", ALL_POINTS, budget.elapsed(), 0, 0, 0, 0.0, value))

    def _of_search(self, solution: Solution) -> Result:
        """Return the result for the points that were searched."""
        problem, mode = self.setup.searched[self.at], self.setup.mode
        normalised, frame = self.normalised, self.normalised.frame
        certificate = self._certificate(solution)
        solution, tolerance = solution.to_input(frame), normalised.tolerance.scaled(frame.area)
        before, greedy = self._matched(solution.T)
        self._complete(solution, before[0])
        upper_bound = solution.upper_bound
        (final, T, pairs), stages = before, list(solution.stages)
        if self.setup.options.polish:
            began = self.placing.elapsed()
            ((final, T, pairs),), spent = refine_poses(problem, [before], self.placing)
            stages.append(
                Stage(
                    "polish", self.placing.elapsed() - began, n_assignments=spent,
                    objective_before=before[0], objective_after=final, greedy_assignment=greedy or None,
                )
            )  # fmt: skip
        elif greedy:
            stages.append(Stage("pairs", 0.0, greedy_assignment=True))
        reached = final if mode.in_norm_space else min(final, upper_bound)
        return Result(
            status=solution.status, model=problem.model, mode=mode.name,
            bound=normalised.bound, T_target_source=T, T_certified=solution.T, assignment=pairs,
            n_inliers=problem.n_inliers, lower_bound=solution.lower_bound, upper_bound=upper_bound,
            max_rms=self.setup.limits.max_rms, memory_estimate=self.setup.memory,
            gap_tol=tolerance.allowed(upper_bound), is_exact=tolerance.is_exact(upper_bound),
            certificate_scope=solution.scope,
            objective=final, objective_certified=before[0],
            n_nodes=sum(stage.n_nodes for stage in solution.stages),
            n_assignments=sum(stage.n_assignments for stage in solution.stages),
            time_setup_s=self.setup.time_s + self.budget.clock.prepared_s,
            time_solve_s=self.placing.elapsed(),
            trace=Trace(solution.events), stages=stages, certificate=certificate,
            runner_up=find_runner_up(problem, T, reached, solution.minima),
        )  # fmt: skip

    def _complete(self, solution: Solution, value: float) -> None:
        """Give the objective of the pose to searches in which no local search ended."""
        if np.isinf(solution.upper_bound):
            solution.upper_bound = value  # norms differ by no more than the points do
        if solution.events and np.isinf(solution.events[-1].upper_bound):
            last = replace(solution.events[-1], time_s=self.placing.elapsed(), upper_bound=value)
            solution.events.append(last)
            self.placing.report(last.scaled(1.0 / self.normalised.frame.area))

    def _matched(self, T: np.ndarray) -> tuple[Pose, bool]:
        """Return the pose with its pairs, and whether these were chosen greedily.

        The pairs of a sample are not returned to the user: they may be rough, and are not called greedy.
        """
        problem, budget = self.setup.searched[self.at], self.placing
        prove = not (self.setup.options.polish or budget.is_over)
        if self.setup.is_sampled:
            clouds, candidates = (problem.source, problem.target), problem.candidates
            value, pairs = objective(
                *clouds, T, problem.n_inliers, candidates,
                prove=prove, stop=budget.hard_stop, at_once=0,
            )  # fmt: skip
            return (value, T, pairs), False
        value, pairs, greedy = quick_objective(
            problem, T, self.known, prove=prove, stop=budget.hard_stop
        )
        return (value, T, pairs), greedy

    def _certificate(self, solution: Solution) -> Certificate | None:
        if not self.normalised.keep_leaves or solution.certified is None:
            return None
        root, found = solution.certified
        problem, mode, normalised = self.setup.searched[self.at], self.setup.mode, self.normalised
        return record(
            found, root, problem, normalised.frame, normalised.tolerance.allowed(found.upper_bound),
            model=mode.certifies, mode=mode.name, bound=normalised.bound,
        )  # fmt: skip


def _scope(problem: Problem, what: str, *, is_sample: bool) -> str:
    """Return what the bounds refer to."""
    where = OF_SAMPLE * is_sample + ", within the range of poses" * (problem.pose_range is not None)
    return what + where + (problem.weights.scope if problem.weights else "")


def exact_value(problem: Problem) -> float:
    """Return the objective up to which a fit is exact, also that of the lightest pairs."""
    lightest = 1.0 if problem.weights is None else float(problem.weights.factors.min())
    return lightest * exact_objective(problem.source, problem.target, problem.n_inliers)


def _region(problem: Problem, frame: Frame) -> Any:
    """Return the admissible poses in normalised coordinates; None: all of the model."""
    if problem.pose_range is None:
        return None
    from dcreg.families.region import Near

    return Near(frame.pose_range(problem.pose_range))


def _special(problem: Problem) -> tuple[bool, bool, bool, bool]:
    """Return `restricted`, `many`, `large` and `whole` of `warm_up_mode` for a problem."""
    restricted, n, m = problem.candidates is not None, len(problem.source), len(problem.target)
    whole = problem.model == "similarity3d" and problem.n_inliers == n == m and not problem.weights
    return restricted, n * m > FEW_PAIRS, not restricted and is_large(n, m), whole
