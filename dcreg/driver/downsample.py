"""Choose the points that are searched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcreg.driver.modes import LARGE_PAIRS, LARGE_SAMPLE
from dcreg.problem import InputError, Problem, representative_points

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
    scaled down with it.

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
    """Refuse an invalid number of points, and settings that a sample would ignore."""
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < problem.dim:
        raise InputError(
            f"downsample: {count!r} is not a number of points; give a whole number such as 200"
        )
    for name, given in (
        ("candidates", problem.candidates is not None),
        ("certificate", certificate),
    ):
        if given:
            raise InputError(
                f"downsample: {name} would not be used with a sample; omit one of the two"
            )


def default_sample(problem: Problem, bound: str | None, certificate: bool) -> int | None:
    """Return the number of points to search with; None: all.

    A sample of large clouds gives a better pose than all points. This does not hold in 3D if all points
    match: then norms suffice.
    """
    n, m = len(problem.source), len(problem.target)
    free = bound is None and not certificate and problem.candidates is None
    by_norms = problem.dim == 3 and problem.n_inliers == n == m
    if not free or by_norms or n * m <= LARGE_PAIRS[problem.dim]:
        return None
    return LARGE_SAMPLE[problem.dim]
