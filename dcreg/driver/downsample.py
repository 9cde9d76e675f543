"""Choose the points that are searched, and refine the pose on all points."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from dcreg import text
from dcreg.assignment.descent import polish
from dcreg.assignment.large import descend, greedy_seconds, near_value, quick_pairs
from dcreg.assignment.objective import Matched, is_large, objective, quick_objective
from dcreg.driver.modes import LARGE_PAIRS, LARGE_SAMPLE, NORM_PAIRS
from dcreg.problem import InputError, Problem, representative_points
from dcreg.problem.geometry import exact_objective, rounding_error, sampled_pairs
from dcreg.problem.trees import tree_of
from dcreg.result import Result, Sample, Stage
from dcreg.runner_up import find_runner_up
from dcreg.search import Budget
from dcreg.status import Status

_LOGGER = logging.getLogger("dcreg")
MAX_OBJECTIVE_RATIO = 4.0  # of a pose to the best one; worse poses are not refined
ALL_POINTS = "all points"  # the stage in which the pose of a sample is refined
# Share of the time for the search of a sample; the rest is for refining its pose on all points.
SEARCH_SHARE = 0.8
LEAST_SHARE = 0.3  # of huge clouds within a short limit
# By dimension: pairs that a sample has at least if one cloud is much larger than the other. In 2D they
# just determine a pose, because larger samples take much longer.
ENOUGH_PAIRS = {2: 4, 3: 30}


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
        Points of each cloud at most; default: `default_sample` of the last problem where no mode is
        asked for, else all.
    mode, bound, certificate
        As asked for.

    Raises
    ------
    InputError
    """
    first = problems[0]
    if downsample is None and mode is None:
        downsample = default_sample(problems[-1], bound, certificate)
    if downsample is None:
        return problems
    _check(downsample, first, certificate)
    source = first.source[representative_points(first.source, downsample)]
    target = first.target[representative_points(first.target, downsample)]
    if len(source) == len(first.source) and len(target) == len(first.target):
        return problems
    clouds, samples = (first.source, first.target), (source, target)
    largest = problems[-1]
    _check_pairs(largest, sampled_pairs(largest.n_inliers, clouds, samples), downsample)
    sample = Problem(source, target, 1, first.model, first.scale_range, pose_range=first.pose_range)
    return [
        sample.with_n_inliers(sampled_pairs(each.n_inliers, clouds, samples)) for each in problems
    ]


def _check_pairs(problem: Problem, n_inliers: int, downsample: int) -> None:
    """Refuse a sample whose pairs fit exactly at wrong poses, too, unless all points have as few."""
    if n_inliers <= problem.dim and n_inliers < problem.n_inliers:
        raise InputError(
            f"downsample: {downsample} points leave {text.count(n_inliers, 'pair')} of "
            f"{problem.n_inliers}, which determine no pose; give at least "
            f"{_points_for(problem.dim + 2, problem)} points, or match more pairs"
        )


def _points_for(n_pairs: int, problem: Problem) -> int:
    """Return how many points of each cloud leave a sample of so many pairs."""
    return math.ceil(n_pairs * max(len(problem.source), len(problem.target)) / problem.n_inliers)


def _check(count: int, problem: Problem, certificate: bool) -> None:
    """Refuse an invalid number of points, and settings that a sample would ignore."""
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < problem.dim:
        raise InputError(
            f"downsample: {count!r}; give a whole number of points, at least {problem.dim}, such as 200"
        )
    given = {
        "candidates": problem.candidates is not None, "certificate": certificate,
        problem.weights.name if problem.weights else "": problem.weights is not None,
    }  # fmt: skip
    for name in filter(given.get, given):
        raise InputError(f"downsample: {name} would not be used with a sample; omit one of the two")


def default_sample(problem: Problem, bound: str | None, certificate: bool) -> int | None:
    """Return the number of points to search with; None: all.

    A sample of large clouds gives a better pose than all points. If one cloud is much larger, its sample
    has more points: otherwise few of the smaller cloud have a partner.
    """
    n, m = len(problem.source), len(problem.target)
    free = bound is None and not certificate and problem.candidates is problem.weights is None
    smaller, largest = min(n, m), LARGE_PAIRS[problem.dim]
    # a small cloud is not sampled to match a large one: that would leave it few partners
    is_lopsided = smaller**2 <= largest
    if not free or (is_lopsided if problem.dim == 3 and n * m <= NORM_PAIRS else n * m <= largest):
        return None
    count = LARGE_SAMPLE[problem.dim]
    if is_lopsided:
        count = max(count, min(_points_for(ENOUGH_PAIRS[problem.dim], problem), largest // smaller))
    return count


def share_of_search(problem: Problem, time_s: float | None) -> float:
    """Return the share of the time for the search of a sample: all points have to be matched after it."""
    if not time_s:
        return SEARCH_SHARE
    return float(np.clip(1.0 - greedy_seconds(problem) / time_s, LEAST_SHARE, SEARCH_SHARE))


# A pose with its objective and its pairs.
Pose = tuple[float, np.ndarray, np.ndarray]
_value = itemgetter(0)


def refined(
    result: Result,
    problem: Problem,
    searched: Problem,
    budget: Budget,
    known: Matched | None = None,
    initial: Sequence[np.ndarray] = (),
) -> Result:
    """Return the result for all points from that of a sample.

    The pose, the runner-up, the `initial` poses and that of the `known` pairs are refined, the best
    first. The runner-up of the result then refers to all points.
    """
    _LOGGER.info("the search of the sample has ended; its pose is refined on all points")
    began = budget.elapsed()
    T = result.T_target_source
    others = [] if result.runner_up is None else [result.runner_up.T_target_source]
    others += initial
    if known is not None:
        others.append(known.T_target_source)
    by_neighbours = is_large(len(problem.source), len(problem.target)) and not budget.is_over
    refine = _refined_large if by_neighbours else _refined_dense
    found = refine(problem, T, others, budget, known)
    value, T, pairs = min(found.poses, key=_value)
    stage = Stage(
        ALL_POINTS, budget.elapsed() - began, n_assignments=found.n_assignments,
        objective_before=found.before, objective_after=value, greedy_assignment=found.greedy or None,
    )  # fmt: skip
    ended = result.status in (Status.OPTIMAL, Status.CONVERGED)
    return replace(
        result,
        status=budget.ended_by if ended and budget.is_over else result.status,
        T_target_source=T,
        assignment=pairs,
        n_inliers=problem.n_inliers,
        objective=value,
        objective_certified=found.before,
        runner_up=find_runner_up(problem, T, value, found.ends),
        stages=[*result.stages, stage],
        downsampled=Sample(len(searched.source), len(searched.target), searched.n_inliers),
    )


class Refined(NamedTuple):
    """The poses of a sample on all points.

    Attributes
    ----------
    poses : list of Pose
    ends : list of (pose, float)
        Where local searches ended, with the objective, or an estimate for a clearly worse pose.
    before : float
        The objective of rough pairs at the first pose, an upper bound on its objective.
    greedy : bool
        Whether the pairs of the first pose were chosen greedily.
    n_assignments : int
    """

    poses: list[Pose]
    ends: list[tuple[np.ndarray, float]]
    before: float
    greedy: bool
    n_assignments: int


def _refined_dense(
    problem: Problem,
    T: np.ndarray,
    others: Sequence[np.ndarray],
    budget: Budget,
    known: Matched | None,
) -> Refined:
    """Match at the poses, and polish them if there is time."""
    clouds, k = (problem.source, problem.target), problem.n_inliers
    before, pairs, greedy = quick_objective(problem, T, known, prove=False, stop=budget.hard_stop)
    poses, ends, spent = [(before, T, pairs)], [], 1
    tree = tree_of(problem.target)
    for other in others:
        if known is not None and other is known.T_target_source:
            value, pairs = known.cheapest(*clouds, other, k)
        elif budget.is_over:
            continue
        # no matching costs less than the distances to the target; one so far away takes long
        elif (far := near_value(problem, other, tree)) > MAX_OBJECTIVE_RATIO * before:
            ends.append((other, _estimate(problem, before, near_value(problem, T, tree), far)))
            continue
        else:
            value, pairs = objective(*clouds, other, k, prove=False, stop=budget.hard_stop)
            spent += 1
        poses.append((value, other, pairs))
    poses, more = refine_poses(problem, poses, budget)
    ends += [(pose, value) for value, pose, _ in poses]
    return Refined(poses, ends, before, greedy, spent + more)


def _estimate(problem: Problem, value: float, near: float, far: float) -> float:
    """Estimate the objective at a pose: objectives differ about as much as distances to the target.

    `value` is the objective at another pose, `near` and `far` are the distances of both.
    """
    rounding = rounding_error(problem.source, problem.target, problem.n_inliers)
    return far * (value + rounding) / (near + rounding)


def _refined_large(
    problem: Problem,
    T: np.ndarray,
    others: Sequence[np.ndarray],
    budget: Budget,
    known: Matched | None,
) -> Refined:
    """Follow nearest neighbours from the poses, and match only where these end."""
    tree, sizes = tree_of(problem.target), (problem.source, problem.target, problem.n_inliers)
    near = [near_value(problem, pose, tree) for pose in (T, *others)]
    with ThreadPoolExecutor(1) as pool:  # both take as long on large clouds
        rough = pool.submit(quick_pairs, problem, T, budget)
        first, own = descend(problem, T, budget, tree), rough.result()
    poses: list[Pose] = [(first.value, first.T_target_source, first.pairs)]
    ends, spent = [(first.T_target_source, first.value)], first.n_assignments
    before = first.before
    is_rough = not first.greedy and first.value > exact_objective(*sizes)
    # the pairs of the last pose can be far from the best ones at the first pose, which can be better
    if is_rough and own is not None:
        before, spent = min(before, own[0]), spent + 1
        poses.append((own[0], T, own[1]))
    for other, distances in zip(others, near[1:], strict=True):
        if first.greedy or budget.is_over:
            break
        if distances > MAX_OBJECTIVE_RATIO * min(near):
            # both at the pose of the sample
            ends.append((other, _estimate(problem, before, near[0], distances)))
            continue
        found = descend(problem, other, budget, tree, prove=False)
        poses.append((found.value, found.T_target_source, found.pairs))
        ends.append((found.T_target_source, found.value))
        spent += found.n_assignments
    if known is not None:
        cheapest = known.cheapest(problem.source, problem.target, poses[0][1], problem.n_inliers)
        poses.append((cheapest[0], poses[0][1], cheapest[1]))
    return Refined(poses, ends, before, first.greedy, spent)


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
        if budget.is_over or value > MAX_OBJECTIVE_RATIO * min(map(_value, refined)):
            break
        T, better, pairs, more = polish(problem, T, budget, (value, known))
        spent += more
        if better < value:
            refined[at] = better, T, pairs
    return refined, spent
