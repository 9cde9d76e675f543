"""Matchings at the centre of a box, bounded by prices that come from the box it is a part of.

In single precision: most boxes are closed or divided without an exact assignment.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.kernels.assignment.selection import smallest_sum, total
from dcreg.kernels.compiling import jit
from dcreg.kernels.points import add_prices
from dcreg.kernels.space.geometry import extent
from dcreg.kernels.space.rough import Bids, bid, rough_costs, rough_minima, settle
from dcreg.kernels.space.stationary import Ways, least_at_corners, room_for_ways

_BIDS = 0.8  # per pair to be matched
_STEP = 0.02  # least raise, in what the k-th row costs: equal columns would be bid for in vain
_CEILING = np.float32(
    1.5
)  # rows that cost this many times the k-th are not matched anywhere in a box
_UNIT = 2.0**-14  # of prices that are kept, in squares of the radius of the target
_MOST = 65_535.0
_ROUNDING = 2.0**-23  # of single precision, relative


class Room(NamedTuple):
    """What the passes over one box work in."""

    moved: np.ndarray
    shifted: np.ndarray
    cost: np.ndarray
    b: np.ndarray
    tried: np.ndarray
    low: np.ndarray
    queue: np.ndarray
    owner: np.ndarray
    totals: np.ndarray
    exact_low: np.ndarray
    ways: Ways


@jit
def room_for_prices(n, m):
    single = np.float32
    return Room(
        np.empty((3, n), single), np.empty((3, m), single), np.empty((n, m), single),
        np.zeros(m, single), np.empty(m, single), np.empty(n, single),
        np.empty(n, np.int64), np.empty(m, np.int64), np.empty(m, np.int32),
        np.empty(n), room_for_ways(n),
    )  # fmt: skip


@jit
def keep_prices(b, kept):
    """Prices by 16 bits each."""
    for j in range(b.size):
        kept[j] = np.uint16(min(_MOST, b[j] / _UNIT + 0.5))


@jit
def priced_bound(view, corners, half, farthest, goal, kept, room):
    """A lower bound on C of `Loss`, up to `goal`, and whether bids for a better one were in vain.

    Parameters
    ----------
    view : View
    corners, half : arrays
        Gibbs vectors of the corners of the box, half its widths in translation.
    farthest : float
        The greatest length of a source point.
    goal : float
    kept : (m,) uint16 array
        Prices from another pose, replaced by better ones.
    room : Room
    """
    _narrow(view.moved, room.moved)
    _narrow(view.shifted, room.shifted)
    rough_costs(room.moved, room.shifted, room.cost)
    add_prices(view.prices, room.cost)
    for j in range(kept.size):
        room.b[j] = np.float32(kept[j] * _UNIT)
    here, level = _settled(view, room.b, room)
    found = _at_corners(view, corners, half, farthest, level, room.b, room)
    in_vain = False
    if found < goal:
        for j in range(kept.size):
            room.tried[j] = room.b[j]
        bids = Bids(int(_BIDS * view.k) + 1, np.float32(level), np.float32(_STEP * level))
        bid(room.cost, room.tried, room.low, bids, room.queue, room.owner, room.totals)
        better, level = _settled(view, room.tried, room)
        in_vain = better <= here
        if not in_vain:
            for j in range(kept.size):
                room.b[j] = room.tried[j]
            found = max(found, _at_corners(view, corners, half, farthest, level, room.b, room))
    keep_prices(room.b, kept)
    return found, in_vain


@jit
def _settled(view, b, room):
    """Settle prices; the sum of the k cheapest rows less all prices, and a cost from the k-th to the
    next."""
    rough_minima(room.cost, b, room.low)
    mean = 0.0
    for i in range(room.low.size):
        room.exact_low[i] = room.low[i]
        mean += room.exact_low[i] / room.low.size
    here, level = smallest_sum(room.exact_low, view.k, mean, 0.02 * mean)
    if view.k == room.low.size:  # no row is left out
        level = room.low.max()
    settle(room.cost, room.low, _CEILING * np.float32(level), b)
    return here - total(b), level


@jit
def _at_corners(view, corners, half, farthest, level, b, room):
    """C of `Loss` from below, with what single precision may be off by."""
    for i in range(room.low.size):
        room.exact_low[i] = room.low[i]
    found = least_at_corners(view.moved, room.exact_low, view.k, corners, half, level, room.ways)
    prices = total(b)
    reach = extent(half.reshape((3, 1)))[1] + 2.0 * extent(corners.T)[1] * farthest  # of a way
    # A residual of length d is off by less than step = 2 eps (|x| + |y|), its square by 2 d step +
    # step^2; the sum of d over k pairs is at most the root of k times the sum of their squares.
    size = max(0.0, found - prices) + view.k * reach * reach
    step = 2.0 * _ROUNDING * (farthest + extent(view.shifted)[1])
    off = 2.0 * step * math.sqrt(view.k * size) + view.k * step * step
    return found - prices - off - 2.0 * _ROUNDING * (size + prices)


@jit
def _narrow(values, out):
    """Copy in single precision."""
    for c in range(values.shape[0]):
        for i in range(values.shape[1]):
            out[c, i] = values[c, i]
