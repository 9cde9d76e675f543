"""Matchings at a pose, bounded by prices that come from another: that of a box this one is a part of.

In single precision: most boxes are closed or divided without an exact assignment.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import smallest_sum, total
from dcreg.families.kernels import add_prices
from dcreg.families.rigid3d.kernels.rough import Bids, bid, rough_costs, rough_minima, settle
from dcreg.families.rigid3d.kernels.stationary import Ways, look_at_corners, room_for_ways
from dcreg.families.rotation3d.kernels.geometry import extent
from dcreg.jit import jit

# Share of a price that is taken over from another pose: all of it would leave columns dear that nobody
# wants here, and bids only raise prices.
_KEPT = 0.7
_BIDS = 2  # per pair to be matched, at most
_ROUNDS = 2  # of bids, at most
# A box is bid for while what it is short of its goal, or beyond it, is this share of what is lost in it.
_HOPELESS, _CERTAIN = -0.4, 0.1
_STEP = 0.02  # least raise, in what the k-th row costs: equal columns would be bid for in vain
_CEILING = np.float32(
    1.5
)  # rows that cost this many times the k-th are not matched anywhere in a box
_ONE = np.float32(1.0)
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
    best_low: np.ndarray
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
        np.zeros(m, single), np.empty(m, single), np.empty(n, single), np.empty(n, single),
        np.empty(n, np.int64), np.empty(m, np.int64), np.empty(m, np.int32),
        np.empty(n), room_for_ways(n),
    )  # fmt: skip


@jit
def keep_prices(b, kept):
    """Prices by 16 bits each."""
    for j in range(b.size):
        kept[j] = np.uint16(min(_MOST, b[j] / _UNIT + 0.5))


@jit
def priced_bound(view, box, farthest, goal, kept, room, out):
    """A lower bound on C of `Loss` and a guess of the costs at the centre.

    Some effort is made where it is in doubt whether they reach `goal`.

    Parameters
    ----------
    view : View
    box : Surroundings
    farthest : float
        The greatest length of a source point.
    goal : float
        For the mean of C and of the sum of costs at the centre.
    kept : (m,) uint16 array
        Prices from another pose, replaced by better ones.
    room : Room
    out : (64,) array
        Receives bounds on C at the corners of the box.
    """
    _begin(view, kept, room)
    here, level = _settled(view, room.b, room, _CEILING)
    room.best_low[:] = room.low
    found = _at_corners(view, box, farthest, level, room, out)
    lost, improved = here - found, False
    for _ in range(_ROUNDS):
        likely = (here - 0.5 * lost - goal) / (lost + goal) if goal < np.inf else 0.0
        if not _HOPELESS < likely < _CERTAIN:
            break
        better, level = _raised(view, level, room, _CEILING)
        if better <= here:
            break
        here, improved = better, True
        room.b[:], room.best_low[:] = room.tried, room.low
    if improved:
        found = _at_corners(view, box, farthest, level, room, out)
    keep_prices(room.b, kept)
    return found, here


@jit
def priced_value(view, farthest, goal, kept, room):
    """A lower bound on the least sum of costs at a pose, up to `goal`; whether more is out of reach."""
    _begin(view, kept, room)
    found, level = _settled(view, room.b, room, _ONE)
    prices = total(room.b)
    off = _rounding(view, farthest, 0.0, found + prices, prices)
    is_final = False
    for at in range(_ROUNDS):
        if found - off >= goal:
            break
        better, level = _raised(view, level, room, _ONE)
        room.b[:] = room.tried
        is_final = better <= found or at == _ROUNDS - 1
        if better <= found:
            break
        found, prices = better, total(room.b)
        off = _rounding(view, farthest, 0.0, found + prices, prices)
    return found - off, is_final


@jit
def _begin(view, kept, room):
    """Costs at a pose, and prices from another."""
    _narrow(view.moved, room.moved)
    _narrow(view.shifted, room.shifted)
    rough_costs(room.moved, room.shifted, room.cost)
    add_prices(view.prices, room.cost)
    for j in range(kept.size):
        room.b[j] = np.float32(kept[j] * (_KEPT * _UNIT))


@jit
def _settled(view, b, room, ceiling):
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
    settle(room.cost, room.low, ceiling * np.float32(level), b)
    return here - total(b), level


@jit
def _raised(view, level, room, ceiling):
    """Try prices raised by bids: the sum of the k cheapest rows less all of them, and a cost as above."""
    room.tried[:] = room.b
    bids = Bids(int(_BIDS * view.k) + 1, np.float32(level), np.float32(_STEP * level))
    bid(room.cost, room.tried, room.low, bids, room.queue, room.owner, room.totals)
    return _settled(view, room.tried, room, ceiling)


@jit
def _at_corners(view, box, farthest, level, room, out):
    """C of `Loss` from below, with what single precision may be off by."""
    for i in range(room.low.size):
        room.exact_low[i] = room.best_low[i]
    found = look_at_corners(
        view.moved, room.exact_low, view.k, box.corners, box.half, level, room.ways, out
    )
    prices = total(room.b)
    reach = box.slack + 2.0 * box.tangent * farthest  # of a way
    off = prices + _rounding(view, farthest, reach, found, prices)
    for corner in range(out.size):
        out[corner] -= off
    return found - off


@jit
def _rounding(view, farthest, reach, found, prices):
    """What single precision may be off by in a sum of k costs less squares of ways up to `reach`.

    A residual of length d is off by less than step = 2 eps (|x| + |y|), its square by 2 d step + step^2;
    the sum of d over k pairs is at most the root of k times the sum of their squares.
    """
    size = max(0.0, found - prices) + view.k * reach * reach
    step = 2.0 * _ROUNDING * (farthest + extent(view.shifted)[1])
    off = 2.0 * step * math.sqrt(view.k * size) + view.k * step * step
    return off + 2.0 * _ROUNDING * (size + prices)


@jit
def _narrow(values, out):
    """Copy in single precision."""
    for c in range(values.shape[0]):
        for i in range(values.shape[1]):
            out[c, i] = values[c, i]
