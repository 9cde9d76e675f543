"""Lower bounds by dual variables that come from another pose, without an exact assignment.

The other pose is that of the parent box. The bounds use single precision. Most boxes are pruned or
divided by them alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.dense import DUAL_UNIT
from dcreg.assignment.kernels.selection import smallest_sum, total
from dcreg.families.kernels import add_penalty, weigh
from dcreg.families.rigid3d.kernels.rough import (
    Auction,
    auction,
    lower_duals,
    rough_costs,
    rough_minima,
)
from dcreg.families.rigid3d.kernels.stationary import costs_at_vertices
from dcreg.families.rotation3d.kernels.geometry import extent
from dcreg.jit import jit, jit_inner, jit_part

# Each dual from another pose is multiplied by this factor. Full duals would stay too high for columns
# that no row needs here, because auction steps only raise duals.
_KEPT = 0.7
_STEPS = 3  # maximum number of auction steps per pair
# Rows that cost up to this multiple of the k-th row take part in auction steps: the k-th cost rises with
# the duals, which rise too little without the rows between.
_LEVEL = 1.15
# Auction steps follow if the bound with half the loss, minus the pruning threshold, is between these
# multiples of the sum of loss and threshold.
_MIN_MARGIN, _MAX_MARGIN = -0.55, 0.1
# ... above which they also improve the bounds at the vertices: other boxes are divided anyway.
_MIN_AGAIN = -0.1
# Minimum raise of a dual, as a share of the k-th row's cost, so that ties between columns do not stall.
_RAISE = 0.01
# Rows that cost more than this multiple of the k-th row are not matched anywhere in a box.
_CEILING = np.float32(1.5)
_ONE = np.float32(1.0)
_LARGEST = 65_535.0
_ROUNDING = 2.0**-23  # of single precision, relative


class Workspace(NamedTuple):
    """Scratch arrays for one box: only few, because each array adds compile time to each kernel.

    Attributes
    ----------
    costs : (n, m) float32 array
    columns : (5, m) float32 array
        The coordinates of the targets, the best duals, and the duals on trial.
    rows : (2, n) float32 array
        Row minima under the duals on trial, and under the best duals.
    integers : (3, max(n, m)) int32 array
        For `auction`.
    exact : (5, n) array
        Row minima, and the work array of `costs_at_vertices`.
    """

    costs: np.ndarray
    columns: np.ndarray
    rows: np.ndarray
    integers: np.ndarray
    exact: np.ndarray


def allocate_workspace(n: int, m: int) -> Workspace:
    """Allocate the scratch arrays for n source and m target points."""
    return Workspace(
        np.empty((n, m), np.float32), np.empty((5, m), np.float32), np.empty((2, n), np.float32),
        np.empty((3, max(n, m)), np.int32), np.empty((5, n)),
    )  # fmt: skip


@jit_part
def keep_duals(b, kept):
    """Store duals in 16 bits each."""
    for j in range(b.size):
        kept[j] = np.uint16(min(_LARGEST, b[j] / DUAL_UNIT + 0.5))


@jit_part
def dual_bound_of_box(view, box, farthest, goal, kept, work, out):
    """Return a lower bound on C of `Loss` and an estimate of the sum of costs at the centre.

    Auction steps improve the bound if it may or may not reach `goal`. Afterwards ``work.columns[3]``
    holds the duals.

    Parameters
    ----------
    view : Clouds
    box : BoxGeometry
    farthest : float
        The maximum norm of a source point.
    goal : float
        Required mean of C and of the sum of costs at the centre.
    kept : (m,) uint16 array
        Duals from another pose; replaced by better ones.
    work : Workspace
    out : (64,) array
        Receives bounds on C at the vertices of the box.
    """
    _begin(view, kept, work)
    here, level = _evaluate(view, _CEILING, work)
    _accept(work)
    found = _at_vertices(view, box, farthest, level, work, out)
    lost = here - found
    if _MIN_MARGIN < _margin(here, lost, goal) < _MAX_MARGIN:
        _auction_steps(view, _LEVEL * level, work)
        better, level = _evaluate(view, _CEILING, work)
        if better > here:
            here = better
            _accept(work)
            if _margin(here, lost, goal) > _MIN_AGAIN:
                found = _at_vertices(view, box, farthest, level, work, out)
    keep_duals(work.columns[3], kept)
    return found, here


@jit
def _accept(work):
    """Accept the duals on trial, with their row minima, as the best ones."""
    for j in range(work.columns.shape[1]):
        work.columns[3, j] = work.columns[4, j]
    for i in range(work.rows.shape[1]):
        work.rows[1, i] = work.rows[0, i]


@jit_part
def _margin(here, lost, goal):
    """Return how far a bound with half the loss exceeds `goal`, as a multiple of loss and goal."""
    return (here - 0.5 * lost - goal) / (lost + goal) if goal < np.inf else 0.0


@jit_part
def dual_bound_at_pose(view, farthest, goal, kept, work):
    """Return a lower bound on the minimum sum of costs at a pose, and whether no better one is possible.

    The bound need not exceed `goal`.
    """
    _begin(view, kept, work)
    found, level = _evaluate(view, _ONE, work)
    proved = found - _rounding_at_pose(view, farthest, found, work)
    if proved >= goal:
        return proved, False
    _auction_steps(view, _LEVEL * level, work)
    found, _ = _evaluate(view, _ONE, work)
    return max(proved, found - _rounding_at_pose(view, farthest, found, work)), True


@jit
def _rounding_at_pose(view, farthest, found, work):
    """Bound the rounding error of a bound at one pose."""
    duals = total(work.columns[4])
    return _rounding(view, farthest, 0.0, found + duals, duals)


@jit
def _begin(view, kept, work):
    """Compute costs at a pose, take duals from another pose, and fill ``work.rows[0]``."""
    for j in range(kept.size):
        for c in range(3):
            work.columns[c, j] = view.target[c, j]
        work.columns[4, j] = np.float32(kept[j] * (_KEPT * DUAL_UNIT))
    rough_costs(view.source, work.columns, work.columns[4], work.costs, work.rows[0])
    if view.infeasibility_penalty.size + view.weights.size > 0:
        add_penalty(view.infeasibility_penalty, work.costs)
        weigh(view.weights, work.costs)
        rough_minima(work.costs, work.columns[4], work.rows[0])


@jit
def _auction_steps(view, level, work):
    """Raise the duals on trial by auction steps of the rows that cost at most `level`.

    ``work.rows[0]`` holds the row minima, clipped by `_evaluate`; afterwards those of all rows.
    """
    limits = Auction(int(_STEPS * view.k) + 1, np.float32(level), np.float32(_RAISE * level))
    auction(work.costs, work.columns[4], work.rows[0], limits, work.integers)
    rough_minima(work.costs, work.columns[4], work.rows[0])


@jit
def _evaluate(view, ceiling, work):
    """Lower the duals on trial; return their bound and a cost between the k-th and the next row.

    ``work.rows[0]`` holds the row minima, and is clipped as in `lower_duals`.
    """
    low, b, exact = work.rows[0], work.columns[4], work.exact[0]
    mean = 0.0
    for i in range(low.size):
        exact[i] = low[i]
        mean += exact[i] / low.size
    here, level = smallest_sum(exact, view.k, mean, 0.02 * mean)
    if view.k == low.size:  # no row is left out
        level = exact[0]
        for i in range(low.size):
            level = max(level, exact[i])
    lower_duals(work.costs, low, ceiling * np.float32(level), b)
    return here - total(b), level


@jit
def _at_vertices(view, box, farthest, level, work, out):
    """Return C of `Loss` from below, minus the rounding error of single precision."""
    low = work.exact[0]
    for i in range(low.size):
        low[i] = work.rows[1, i]
    found = costs_at_vertices(view, low, box, level, work.exact, out)
    duals = total(work.columns[3])
    reach = box.shift_radius + 2.0 * box.tangent * farthest  # of a displacement
    off = duals + _rounding(view, farthest, reach, found, duals)
    for vertex in range(out.size):
        out[vertex] -= off
    return found - off


@jit
def _rounding(view, farthest, reach, found, duals):
    """Bound the rounding error of single precision in a sum of k costs minus squared displacements.

    Displacements are at most `reach`. The error of a residual of length d is below step = 2 eps (|x| +
    |y|), and that of its square below 2 d step + step^2. The sum of d over k pairs is at most the root
    of k times the sum of their squares.
    """
    size = max(0.0, found - duals) + view.k * reach * reach
    step = 2.0 * _ROUNDING * (farthest + extent(view.target)[1])
    off = 2.0 * step * math.sqrt(view.k * size) + view.k * step * step
    return off + 2.0 * _ROUNDING * (size + duals)


@jit_inner
def raise_duals(view, attempt, level, kept, work):
    """Raise the duals by auction steps; return their bound on the sum of costs, and the next `level`.

    Attempt 0 takes duals of zero. ``work.columns[4]`` holds the duals, ``work.rows[0]`` the row minima.
    """
    if attempt == 0:
        for j in range(kept.size):
            kept[j] = 0
        _begin(view, kept, work)
    else:
        _auction_steps(view, level, work)
    found, level = _evaluate(view, _ONE, work)
    rough_minima(work.costs, work.columns[4], work.rows[0])  # of all rows: `lower_duals` clips them
    return found, level


@jit_inner
def region_rounding(view, shift_radius, rotation_radius, found, duals):
    """Bound the rounding error of single precision in a sum of k costs less squared displacements.

    A point moves by at most `shift_radius` plus `rotation_radius` times its distance from the origin.
    """
    farthest = extent(view.source)[1]
    return _rounding(view, farthest, shift_radius + rotation_radius * farthest, found, duals)
