"""Advice on what most often goes wrong with one's own clouds."""

from __future__ import annotations

import math
from collections.abc import Iterator

from dcreg.problem.problem import Problem
from dcreg.problem.tolerance import rms_radius

_MANY_POINTS = 4000
_OPERATIONS_PER_SECOND = 1e9


def advice(problem: Problem) -> Iterator[str]:
    """Warnings and hints, one line each; none where nothing looks odd.

    Parameters
    ----------
    problem : Problem

    Yields
    ------
    str
        Beginning with ``warning:`` or ``hint:``.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> cube = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    >>> for line in dcreg.advice(dcreg.Problem(cube, 1000 * cube, 4, "rigid3d")):
    ...     print(line[:65])
    hint: the RMS radii differ a lot (source 0.75, target 750), and r
    """
    n, m = len(problem.source), len(problem.target)
    if max(n, m) > _MANY_POINTS:
        work = float(problem.n_inliers) * n * m
        yield (
            f"warning: {n} x {m} points. Each exact assignment takes {_bytes(8.0 * n * m)} and up "
            f"to K n m = {work:.0e} operations (at worst about "
            f"{_duration(work / _OPERATIONS_PER_SECOND)}), and a "
            "search takes hundreds of them. Search with some of the points: downsample=200, "
            "--downsample 200."
        )
    radii = rms_radius(problem.source), rms_radius(problem.target)
    ratio = radii[0] / radii[1] if radii[1] > 0 else math.inf
    if problem.model == "rigid3d" and not 0.5 <= ratio <= 2.0:
        yield (
            f"hint: the RMS radii differ a lot (source {radii[0]:.4g}, target {radii[1]:.4g}), and "
            "rigid3d has no scale. If the units differ, rescale one cloud; for two views that "
            "overlap in part this may be all right."
        )


def _bytes(count: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def _duration(seconds: float) -> str:
    for unit, size in (("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"
