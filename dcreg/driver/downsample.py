"""Large clouds: search with some of the points, then refine the pose on all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dcreg.assignment.polish import is_greedy, objective, polish
from dcreg.assignment.reuse import Matched, quick_objective
from dcreg.driver.modes import default_sample
from dcreg.problem import InputError, Problem, representative_points
from dcreg.result import Result, Sample, Stage
from dcreg.runner_up import find_runner_up
from dcreg.search import Budget
from dcreg.status import Status

# Of the time, for the search of a sample: the rest is for refining its pose on all points.
SEARCH_SHARE = 0.8
HOPELESS = 4.0  # times the best objective, from which on a pose is not refined


def to_search(
    problems: Sequence[Problem],
    downsample: int | None,
    mode: str | None,
    bound: str | None,
    certificate: bool = False,
) -> Sequence[Problem]:
    """What is searched for each of several problems over the same clouds: itself, or a sample of it.

    A sample is of farthest points of both clouds, stray ones left out, with pairs in the same proportion.

    Parameters
    ----------
    problems : sequence of Problem
        Fewest pairs first.
    downsample : int, optional
        Points of each cloud at most; default: `default_sample` of the first problem where no mode is
        asked for, else all.
    mode, bound, certificate
        As asked for.

    Raises
    ------
    InputError
    """
    first = problems[0]
    if downsample is None and mode is None:
        downsample = default_sample(first, bound, certificate)
    if downsample is None:
        return problems
    _check(downsample, first, certificate)
    source = first.source[representative_points(first.source, downsample)]
    target = first.target[representative_points(first.target, downsample)]
    if len(source) == len(first.source) and len(target) == len(first.target):
        return problems
    share = min(len(source), len(target)) / min(len(first.source), len(first.target))
    return [
        Problem(
            source, target, max(1, round(share * problem.n_inliers)), problem.model,
            problem.scale_range,
        )
        for problem in problems
    ]  # fmt: skip


def _check(count: int, problem: Problem, certificate: bool) -> None:
    """Refuse what is no number of points, and what a sample would ignore."""
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < problem.dim:
        raise InputError(
            f"downsample: {count!r} is no number of points; give a whole number such as 200"
        )
    for name, given in (
        ("candidates", problem.candidates is not None),
        ("certificate", certificate),
    ):
        if given:
            raise InputError(f"downsample: {name} speak of all points; leave one of both out")


def refined(
    result: Result,
    problem: Problem,
    searched: Problem,
    budget: Budget,
    known: Matched | None = None,
) -> Result:
    """The result of a sample, its pose refined on all points.

    The pose of the `known` pairs and the runner-up are refined as well, the best of them first; the
    runner-up of the result then refers to all points too.
    """
    began = budget.elapsed()
    clouds, k = (problem.source, problem.target), problem.n_inliers
    T, spent = result.T_target_source, 1
    before, pairs = quick_objective(*clouds, T, k, known=known, prove=False, stop=budget.hard_stop)
    greedy = is_greedy(len(problem.source), len(problem.target), budget.hard_stop)
    ends = [(before, T, pairs)]
    if result.runner_up is not None and not budget.is_over:
        T, spent = result.runner_up.T_target_source, spent + 1
        value, pairs = objective(*clouds, T, k, prove=False, stop=budget.hard_stop)
        ends.append((value, T, pairs))
    if known is not None:
        value, pairs = known.cheapest(*clouds, known.T_target_source, k)
        ends.append((value, known.T_target_source, pairs))
    ends.sort(key=_value)
    for at, (value, T, _) in enumerate(ends):
        if budget.is_over or value > HOPELESS * min(map(_value, ends)):
            break
        T, less, pairs, more = polish(*clouds, T, k, problem.scale_range, budget=budget)
        spent += more
        if less < value:
            ends[at] = less, T, pairs
    value, T, pairs = min(ends, key=_value)
    stage = Stage(
        "all points", budget.elapsed() - began, n_assignments=spent,
        objective_before=before, objective_after=value, greedy_assignment=greedy or None,
    )  # fmt: skip
    ended = result.status in (Status.OPTIMAL, Status.CONVERGED)
    return replace(
        result,
        status=budget.ended_by if ended and budget.is_over else result.status,
        T_target_source=T,
        assignment=pairs,
        n_inliers=problem.n_inliers,
        objective=value,
        objective_certified=before,
        runner_up=find_runner_up(problem, T, value, [(other, cost) for cost, other, _ in ends]),
        stages=[*result.stages, stage],
        downsampled=Sample(len(searched.source), len(searched.target), searched.n_inliers),
    )


def _value(end: tuple[float, np.ndarray, np.ndarray]) -> float:
    return end[0]
