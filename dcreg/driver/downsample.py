"""Choose the points that are searched, and refine the pose on all points."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from dcreg.assignment.descent import polish
from dcreg.assignment.objective import Matched, objective, quick_objective
from dcreg.diagnostics import find_runner_up
from dcreg.driver.modes import LARGE_PAIRS, LARGE_SAMPLE, NORM_PAIRS
from dcreg.problem import InputError, Problem, representative_points
from dcreg.problem.geometry import sampled_pairs
from dcreg.result import Result, Sample, Stage
from dcreg.search import Budget
from dcreg.status import Status

_LOGGER = logging.getLogger("dcreg")
HOPELESS = 4.0  # poses with more than this many times the best objective are not refined
# Share of the time for the search of a sample; the rest is for refining its pose on all points.
SEARCH_SHARE = 0.8


def to_search(
    problems: Sequence[Problem],
    downsample: int | None,
    mode: str | None,
    bound: str | None,
    certificate: bool = False,
) -> Sequence[Problem]:
    """Return what is searched for each of several problems over the same clouds: itself, or a sample.

    A sample consists of farthest points of both clouds after outlier removal; the number of pairs is
    scaled down with it (`sampled_pairs`).

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
    clouds, samples = (first.source, first.target), (source, target)
    sample = Problem(source, target, 1, first.model, first.scale_range)
    return [
        sample.with_n_inliers(sampled_pairs(each.n_inliers, clouds, samples)) for each in problems
    ]


def _check(count: int, problem: Problem, certificate: bool) -> None:
    """Refuse an invalid number of points, and settings that a sample would ignore."""
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < problem.dim:
        raise InputError(
            f"downsample: {count!r} is not a number of points; give a whole number such as 200"
        )
    given = {"candidates": problem.candidates is not None, "certificate": certificate}
    for name in filter(given.get, given):
        raise InputError(f"downsample: {name} would not be used with a sample; omit one of the two")


def default_sample(problem: Problem, bound: str | None, certificate: bool) -> int | None:
    """Return the number of points to search with; None: all.

    A sample of large clouds gives a better pose than all points. This does not hold in 3D if all points
    match: then norms suffice.
    """
    n, m = len(problem.source), len(problem.target)
    free = bound is None and not certificate and problem.candidates is None
    by_norms = problem.dim == 3 and problem.n_inliers == n == m
    # a small cloud is not sampled to match a large one: that would leave it few partners
    is_lopsided = problem.dim == 3 and n * m <= NORM_PAIRS
    pairs = min(n, m) ** 2 if is_lopsided else n * m
    if not free or by_norms or pairs <= LARGE_PAIRS[problem.dim]:
        return None
    return LARGE_SAMPLE[problem.dim]


# A pose with its objective and its pairs.
Pose = tuple[float, np.ndarray, np.ndarray]
_value = itemgetter(0)


def refined(
    result: Result,
    problem: Problem,
    searched: Problem,
    budget: Budget,
    known: Matched | None = None,
) -> Result:
    """Return the result for all points from that of a sample.

    The pose, the runner-up and the pose of the `known` pairs are refined, the best of them first. The
    runner-up of the result then refers to all points.
    """
    _LOGGER.info("the search of the sample has ended; its pose is refined on all points")
    began = budget.elapsed()
    clouds, k = (problem.source, problem.target), problem.n_inliers
    T = result.T_target_source
    before, pairs, greedy = quick_objective(problem, T, known, prove=False, stop=budget.hard_stop)
    poses, tried = [(before, T, pairs)], 1
    if result.runner_up is not None and not budget.is_over:
        T, tried = result.runner_up.T_target_source, tried + 1
        value, pairs = objective(*clouds, T, k, prove=False, stop=budget.hard_stop)
        poses.append((value, T, pairs))
    if known is not None:
        value, pairs = known.cheapest(*clouds, known.T_target_source, k)
        poses.append((value, known.T_target_source, pairs))
    poses, spent = refine_poses(problem, poses, budget)
    value, T, pairs = min(poses, key=_value)
    stage = Stage(
        "all points", budget.elapsed() - began, n_assignments=tried + spent,
        objective_before=before, objective_after=value, greedy_assignment=greedy or None,
    )  # fmt: skip
    ended = result.status in (Status.OPTIMAL, Status.CONVERGED)
    return replace(
        result,
        status=budget.ended_by if ended and budget.is_over else result.status,
        T_target_source=T,
        assignment=pairs,
        n_inliers=k,
        objective=value,
        objective_certified=before,
        runner_up=find_runner_up(problem, T, value, [(other, cost) for cost, other, _ in poses]),
        stages=[*result.stages, stage],
        downsampled=Sample(len(searched.source), len(searched.target), searched.n_inliers),
    )


def refine_poses(problem: Problem, poses: Sequence[Pose], budget: Budget) -> tuple[list[Pose], int]:
    """Polish the poses in ascending order of their objective, as far as the budget allows.

    Returns
    -------
    poses : list of Pose
        None is worse than before.
    n_assignments : int
    """
    refined, spent = sorted(poses, key=_value), 0
    for at, (value, T, known) in enumerate(refined):
        if budget.is_over or value > HOPELESS * min(map(_value, refined)):
            break
        T, better, pairs, more = polish(problem, T, budget, (value, known))
        spent += more
        if better < value:
            refined[at] = better, T, pairs
    return refined, spent
