"""An estimate of the time of the stages that precede and follow a search, from the sizes of the clouds.

The constants are CPU seconds measured once; `slowness` converts them to those of this machine. The search
itself has no estimate: it ends with a proof or at a limit.
"""

from __future__ import annotations

import time

import numpy as np

from dcreg.assignment.objective import is_large
from dcreg.driver.downsample import ALL_POINTS
from dcreg.families.mode import Mode
from dcreg.problem import Problem

INITIAL_POSES = "initial poses"
# In 3D: per point, up to a maximum; and per pair of points.
_POINT_S, _MOST_S, _PAIR_S = 4e-3, 2.1, 2e-6
# In 2D: for `_FLAT_PAIRS` pairs of points, and the power of their number.
_FLAT_S, _FLAT_PAIRS, _FLAT_POWER = 0.08, 1e4, 1.2
# On all points: per cube of the larger size, for a dense matching; per point of the larger cloud; and per
# point of huge clouds, from `_ONE_FROM` on, which are matched once.
_DENSE_S, _SEVERAL_S, _ONE_S, _ONE_FROM = 6e-10, 1e-4, 4.5e-5, 40_000
_PROBE_POINTS, _PROBE_S = 200_000, 2.1e-3


def first_stages(problem: Problem, searched: Problem, mode: Mode) -> dict[str, float]:
    """Return the seconds of the initial poses of a search, and of refining its pose on all points.

    Parameters
    ----------
    problem : Problem
        As given.
    searched : Problem
        `problem` itself or a sample of it.
    mode : Mode

    Returns
    -------
    dict of str to float
        Seconds by stage. Stages in norm space are left out: they use the rest of the time limit.
    """
    found, factor = {}, slowness()
    n, m = len(searched.source), len(searched.target)
    if problem.dim == 2:
        found[INITIAL_POSES] = factor * _FLAT_S * (n * m / _FLAT_PAIRS) ** _FLAT_POWER
    elif not mode.in_norm_space:
        found[INITIAL_POSES] = factor * (min(_MOST_S, _POINT_S * min(n, m)) + _PAIR_S * n * m)
    if searched is not problem:
        n, m = len(problem.source), len(problem.target)
        larger = max(n, m)
        seconds = larger * (_SEVERAL_S if larger <= _ONE_FROM else _ONE_S)
        found[ALL_POINTS] = factor * (seconds if is_large(n, m) else _DENSE_S * larger**3)
    return found


def slowness() -> float:
    """Return the time of a small computation, divided by that on the machine of the constants."""
    points, times = np.ones((3, _PROBE_POINTS)), []
    for _ in range(5):
        began = time.perf_counter()
        gaps = points - points[:, :1]
        (gaps * gaps).sum(axis=0)
        times.append(time.perf_counter() - began)
    return min(times) / _PROBE_S
