"""Prices of all pairs at one pose in single precision: rough, and several times as fast as exact ones.

Whatever prices these passes end at, the bound they give is valid up to rounding, which the caller allows
for. Every pass runs along the targets, which is what lets the compiler vectorise it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import types

from dcreg.jit import intrinsic, jit, jit_reduction

_NONE = np.int32(0x7F800000)  # the bits of infinity
_ZERO = np.float32(0.0)


@intrinsic(lambda value: value.view(np.int32))
def _bits(typing_context, value):
    """The 32 bits of a number: of those that are not negative, in their order."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(types.float32), generate


@intrinsic(lambda bits: bits.view(np.float32))
def _as_float(typing_context, bits):
    """The number with these 32 bits."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@jit_reduction
def rough_costs(moved, shifted, out):
    """(n, m) squared distances."""
    u, v, w = shifted[0], shifted[1], shifted[2]
    for i in range(out.shape[0]):
        x, y, z = moved[0, i], moved[1, i], moved[2, i]
        row = out[i]
        for j in range(out.shape[1]):
            a, b, c = x - u[j], y - v[j], z - w[j]
            row[j] = a * a + b * b + c * c


@jit_reduction
def rough_minima(cost, b, low):
    """low_i = min_j (c_ij + b_j)."""
    for i in range(cost.shape[0]):
        row, best = cost[i], _NONE
        for j in range(cost.shape[1]):
            best = min(best, _bits(row[j] + b[j]))
        low[i] = _as_float(best)


@jit_reduction
def settle(cost, low, ceiling, b):
    """The least prices under which no row pays less than now, or than `ceiling` where it pays more.

    Prices that no row stands behind any more fall, as they must where they come from another pose. `low`
    is cut at the ceiling, above which it no longer holds.
    """
    for j in range(b.size):
        b[j] = _ZERO
    for i in range(low.size):
        own, row = min(low[i], ceiling), cost[i]
        low[i] = own
        for j in range(b.size):
            gain = own - row[j]
            b[j] = gain if gain > b[j] else b[j]


@jit_reduction
def _two_least(row, b, places, totals):
    """Where the cheapest column of a row is, and the totals of the two cheapest, cut to some digits.

    The last bits of every total make room for its column: so one minimum gives both.
    """
    first = second = _NONE
    for j in range(b.size):
        totals[j] = (_bits(row[j] + b[j]) & ~places) | np.int32(j)
        first = min(first, totals[j])
    for j in range(b.size):
        second = min(second, totals[j] if totals[j] != first else _NONE)
    return first & places, _as_float(first & ~places), _as_float(second & ~places)


class Bids(NamedTuple):
    """How many bids there are at most, what a row may pay, and the least raise."""

    most: int
    level: float
    step: float


@jit
def bid(cost, b, low, bids, queue, owner, totals):
    """Raise prices by bids: a rough auction, which rows leave where it costs more than they may pay.

    `low` are the row minima under the prices; the last three are room to work in: (n,), (m,) and (m,)
    integers, the last of 32 bits.
    """
    left = bids.most
    places, size = np.int32(1), 0
    while places < b.size:
        places *= np.int32(2)
    places -= np.int32(1)
    for i in range(low.size):
        if low[i] <= bids.level:
            queue[size] = i
            size += 1
    for j in range(b.size):
        owner[j] = -1
    head, tail = 0, size if size < queue.size else 0
    while size > 0 and left > 0:
        i = queue[head]
        head = head + 1 if head + 1 < queue.size else 0
        size -= 1
        left -= 1
        at, first, second = _two_least(cost[i], b, places, totals)
        if first > bids.level:
            continue
        loser = owner[at]
        owner[at] = i
        if loser >= 0 or b[at] > _ZERO:
            b[at] += min(second, bids.level) - first + bids.step
        if loser >= 0:
            queue[tail] = loser
            tail = tail + 1 if tail + 1 < queue.size else 0
            size += 1
