"""`register`: from two clouds to a certified pose."""

from __future__ import annotations

import logging
import time
from dataclasses import replace

import numpy as np

from dcreg.assignment.polish import is_greedy, objective
from dcreg.assignment.polish import polish as polish_pose
from dcreg.assignment.reuse import Matched
from dcreg.certificate.format import Certificate
from dcreg.certificate.record import record
from dcreg.diagnostics import Case, advice, warnings_for
from dcreg.driver.downsample import SEARCH_SHARE, refined, to_search
from dcreg.driver.modes import Mode, choose_mode, find_mode
from dcreg.driver.options import START_BOXES, SolveOptions
from dcreg.driver.task import Answer, Task
from dcreg.driver.warm_up import special, warm_up_mode
from dcreg.names import AUTO, DEFAULT_TIME_LIMIT_S
from dcreg.problem import (
    EXACT,
    Candidates,
    Frame,
    InputError,
    Problem,
    default_gap_tol,
    gap_tol_of,
)
from dcreg.result import Result, Stage
from dcreg.runner_up import find_runner_up
from dcreg.search import Budget, Leaves, Listener, Trace
from dcreg.status import Status

MAX_THREADS = 1024
_LOGGER = logging.getLogger("dcreg")


def register(
    source: np.ndarray,
    target: np.ndarray,
    *,
    n_inliers: int | float,
    model: str,
    scale_range: tuple[float, float] | None = None,
    candidates: Candidates | None = None,
    gap_tol: float | None = None,
    tol: float | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    node_limit: int | None = None,
    memory_limit_mb: float | None = None,
    options: SolveOptions | None = None,
) -> Result:
    """Register two clouds without correspondences, globally and with a certificate.

    Minimises, over poses T of the model and one-to-one matchings P of exactly `n_inliers` pairs,
    ``sum_ij p_ij |T(x_i) - y_j|^2`` by branch and bound over the pose (DC-Reg, arXiv 2603.25442).
    In 3D the paper's mode certifies the translation of the norm objective
    ``sum p_ij (|x_i + t| - |y_j|)^2`` and recovers the rotation after it.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
        d = 2 for ``similarity2d``, 3 for ``rigid3d``. In any unit of length.
    n_inliers : int or float
        Pairs to match; a float in (0, 1] is a fraction of ``min(n, m)``.
    model : {"similarity2d", "rigid3d"}
    scale_range : (low, high), optional
        Admissible scale, 2D only; default (0.5, 1.5). Equal numbers fix the scale: ``(1, 1)`` searches
        rotation and translation alone.
    gap_tol : float, optional
        Absolute tolerance on the gap of the objective, in squared units of the target; default
        ``n_inliers * (0.03 * RMS radius of the target)^2`` (`dcreg.default_gap_tol`), and with 0.003
        where the bounds speak of norms, which fit better than points.
    tol : float, optional
        The same as a length, the RMS residual per pair in units of the target:
        ``gap_tol = n_inliers * tol^2``. Only one of the two can be given.
    time_limit : float, optional
        Seconds for the solve, 60 unless told otherwise; None or inf: no limit. The best pose so far is
        returned with status ``time_limit``, at most a tenth of the limit and a second later.
    node_limit : int, optional
        Boxes bounded per stage; the round begun, of up to a thousand boxes, is ended.
    memory_limit_mb : float, optional
        Memory of the open boxes; up to three times that is in use while their number grows.
    candidates : (n, m) bool array, or n sequences of target indices, optional
        The feasible pairs, e.g. from descriptors or a distance gate; all others are ruled out in the
        objective, the bounds and the answer.
    options : SolveOptions, optional
        How to solve: mode, bound, threads, polish, certificate, downsampling, listener.

    Returns
    -------
    Result
        In the coordinates of the input.

    Raises
    ------
    InputError
        For bad input, before any search, naming field, value and remedy.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((20, 2))
    >>> result = dcreg.register(points, points + 3.0, n_inliers=20, model="similarity2d")
    >>> result.status.value, np.round(result.translation, 6).tolist()
    ('optimal', [3.0, 3.0])
    """
    began = time.perf_counter()
    problem = Problem(source, target, n_inliers, model, scale_range, candidates)
    options = options or SolveOptions()
    bound, certificate, threads = options.bound, options.certificate, options.threads
    asked = None if options.mode == AUTO else options.mode
    (searched,) = to_search([problem], options.downsample, asked, bound, certificate)
    way = find_mode(model, asked or choose_mode(searched, bound, certificate))
    way.check(searched, bound, certificate)
    gap_tol = gap_tol_of(tol, gap_tol, searched.n_inliers)
    check_settings(
        gap_tol=gap_tol, time_limit=time_limit, node_limit=node_limit,
        memory_limit_mb=memory_limit_mb, threads=threads,
    )  # fmt: skip
    rotation_tol = gap_tol
    if gap_tol is None:
        gap_tol, rotation_tol = default_tolerances(searched, way)
    advise(searched)
    warm_up_mode(way, bound, *special(searched))
    time_setup = time.perf_counter() - began

    told = in_file_units(options.listener, Frame.of(searched).area)
    with Budget(time_limit, node_limit, memory_limit_mb, told) as budget:
        searching = budget if searched is problem else budget.isolated_sub_budget(SEARCH_SHARE)
        task = task_of(
            searched, way, bound, gap_tol, threads, searching, reduced_box=options.start_box == START_BOXES[0],
            rotation_tol=rotation_tol,
        )  # fmt: skip
        task = replace(task, leaves=Leaves() if certificate else None)
        answer = way.run(task)
        answer.events = budget.history
        result = result_of(
            searched, way, task, answer, polish=options.polish, time_setup_s=time_setup
        )
        result = completed(result, problem, searched, way, budget)
        return replace(result, time_solve_s=budget.elapsed())


def completed(
    result: Result,
    problem: Problem,
    searched: Problem,
    mode: Mode,
    budget: Budget,
    known: Matched | None = None,
) -> Result:
    """The result of what was searched as that of the problem: for all its points, and with warnings."""
    if searched is not problem:
        result = refined(result, problem, searched, budget, known)
    return replace(result, warnings=warnings_for(Case(problem, result, mode.in_norm_space)))


def default_tolerances(problem: Problem, mode: Mode) -> tuple[float, float]:
    """The gaps asked of the certified search and of rotation searches, in squared units of the target."""
    source, target, k = problem.source, problem.target, problem.n_inliers
    return default_gap_tol(source, target, k, mode.tolerated), default_gap_tol(source, target, k)


def task_of(
    problem: Problem,
    mode: Mode,
    bound: str | None,
    gap_tol: float,
    threads: int,
    budget: Budget,
    *,
    reduced_box: bool = True,
    rotation_tol: float | None = None,
) -> Task:
    """The normalised task of a problem; tolerances in the units of the clouds."""
    frame = Frame.of(problem)
    return Task(
        frame.source(problem.source),
        frame.target(problem.target),
        problem.n_inliers,
        problem.scale_range,
        problem.candidates,
        bound or mode.own_bound,
        reduced_box,
        gap_tol / frame.area,
        threads,
        budget,
        rotation_tol=None if rotation_tol is None else rotation_tol / frame.area,
    )


def result_of(
    problem: Problem,
    mode: Mode,
    task: Task,
    answer: Answer,
    *,
    polish: bool,
    time_setup_s: float,
    budget: Budget | None = None,
    matched: tuple[float, np.ndarray] | None = None,
) -> Result:
    """The answer in the coordinates of the clouds, its pose polished as far as the budget allows.

    Parameters
    ----------
    problem, mode, task, answer
    polish : bool
    time_setup_s : float
    budget : Budget, optional
        Of the polish; default: the task's.
    matched : (value, pairs), optional
        At the pose; default: `objective`'s.
    """
    budget = budget or task.budget
    frame = Frame.of(problem)
    area = frame.area
    T = T_certified = frame.pose(answer.T)
    value, pairs = matched or objective(
        problem.source, problem.target, T, problem.n_inliers, problem.candidates,
        prove=not (polish or budget.is_over), stop=budget.hard_stop,
    )  # fmt: skip
    greedy = is_greedy(len(problem.source), len(problem.target), budget.hard_stop)
    # where not one descent came to its end; norms differ by no more than the points do
    upper_bound = value if np.isinf(answer.upper_bound) else answer.upper_bound * area
    final = value
    stages = [stage.scaled(area) for stage in answer.stages]
    if greedy and not polish:
        stages.append(Stage("pairs", 0.0, greedy_assignment=True))
    if polish:
        polishing, spent = budget.elapsed(), 0
        if not budget.is_over:
            T, final, pairs, spent = polish_pose(
                problem.source, problem.target, T_certified, problem.n_inliers,
                problem.scale_range, problem.candidates, budget,
            )  # fmt: skip
        stages.append(
            Stage(
                "polish", budget.elapsed() - polishing, n_assignments=spent,
                objective_before=value, objective_after=final, greedy_assignment=greedy or None,
            )
        )  # fmt: skip
    return Result(
        status=_status(mode, answer, upper_bound / area, problem.n_inliers),
        model=problem.model,
        mode=mode.name,
        bound=task.bound,
        T_target_source=T,
        T_certified=T_certified,
        assignment=pairs,
        n_inliers=problem.n_inliers,
        lower_bound=answer.lower_bound * area,
        upper_bound=upper_bound,
        gap_tol=task.gap_tol * area,
        certificate_scope=answer.scope,
        objective=final,
        objective_certified=value,
        n_nodes=sum(stage.n_nodes for stage in answer.stages),
        n_assignments=sum(stage.n_assignments for stage in answer.stages),
        time_setup_s=time_setup_s,
        time_solve_s=budget.elapsed(),
        trace=Trace([event.scaled(area) for event in answer.events]),
        stages=stages,
        certificate=_certificate(problem, mode, task, answer),
        runner_up=find_runner_up(
            problem,
            T,
            final if mode.in_norm_space else min(final, upper_bound),
            ((frame.pose(end), value * area) for end, value in answer.ends),
        ),
    )


def _status(mode: Mode, answer: Answer, upper_bound: float, n_inliers: int) -> Status:
    """`optimal` only where the bounds say more than that squares are not negative.

    Norms can agree where points do not: in norm space an upper bound within the tolerance says nothing
    of the pose, unless the norms agree exactly.
    """
    trivial = mode.in_norm_space and answer.lower_bound <= 0.0
    if answer.status is Status.OPTIMAL and trivial and upper_bound > EXACT * n_inliers:
        return Status.CONVERGED
    return answer.status


def _certificate(problem: Problem, mode: Mode, task: Task, answer: Answer) -> Certificate | None:
    if task.leaves is None or answer.cover is None:
        return None
    start, found = answer.cover
    return record(
        found, task.leaves, start, problem,
        family=mode.certifies, mode=mode.name, bound=task.bound, gap_tol=task.gap_tol,
    )  # fmt: skip


def check_settings(**settings: float | None) -> None:
    """Refuse limits and tolerances that make no sense.

    Raises
    ------
    InputError
    """
    for name, value in settings.items():
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            raise InputError(f"{name}: {value!r} is not a number; give a positive number")
        least = 1 if name in ("node_limit", "threads") else 0
        endless = name == "time_limit" and value == np.inf
        if (
            not (value < np.inf or endless)
            or value < least
            or (name == "time_limit" and value == 0)
        ):
            raise InputError(f"{name}: {value} is not a usable value; give a positive number")
        if name == "threads" and value > MAX_THREADS:
            raise InputError(f"threads: {value} are too many; give at most {MAX_THREADS}")


def advise(problem: Problem) -> None:
    """Tell, before a search, what most often goes wrong: records of level INFO."""
    for line in advice(problem):
        _LOGGER.info(line)


def in_file_units(listener: Listener | None, area: float) -> Listener | None:
    """The listener, told of events in the units of the clouds."""
    if listener is None:
        return None
    return lambda event: listener(event.scaled(area))
