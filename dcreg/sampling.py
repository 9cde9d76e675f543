"""Large clouds: search with some of the points, then refine the pose on all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dcreg.local import Matched, polish, quick_objective
from dcreg.modes.table import default_sample
from dcreg.problem import InputError, Problem, representative_points
from dcreg.result import Result, Stage
from dcreg.search import Budget

# Of the time, for the search of a sample: the rest is for refining its pose on all points.
SEARCH_SHARE = 0.8


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

    The pose of the `known` pairs is refined as well, the better of the two first.
    """
    began = budget.elapsed()
    clouds, k = (problem.source, problem.target), problem.n_inliers
    T, spent = result.T_target_source, 1
    before, pairs = quick_objective(*clouds, T, k, known=known, prove=False, stop=budget.closed)
    starts = [(before, T, pairs)]
    if known is not None:
        other, cheapest = known.cheapest(*clouds, known.T_target_source, k)
        starts.append((other, known.T_target_source, cheapest))
    starts.sort(key=lambda start: start[0])
    value, T, pairs = starts[0]
    for _, start, _ in starts:
        if budget.is_over:
            break
        better, least, chosen, more = polish(*clouds, start, k, problem.scale_range, budget=budget)
        spent += more
        if least < value:
            T, value, pairs = better, least, chosen
    stage = Stage(
        "all points", budget.elapsed() - began, n_assignments=spent,
        objective_before=before, objective_after=value,
    )  # fmt: skip
    return replace(
        result,
        T_target_source=T,
        assignment=pairs,
        n_inliers=problem.n_inliers,
        objective=value,
        objective_certified=before,
        stages=[*result.stages, stage],
        downsampled=(len(searched.source), len(searched.target), searched.n_inliers),
    )
