"""Dual variables at one pose in single precision: approximate, and several times as fast.

All duals give a valid bound up to rounding, which the caller subtracts. Each pass runs along the
targets, so that the compiler vectorises it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.jit import jit_inner, jit_reduction

# Non-negative numbers have the order of their bits, whose minimum the compiler vectorises.
_NONE = np.int32(0x7F800000)  # the bits of infinity
_ZERO = np.float32(0.0)


@jit_reduction
def rough_costs(moved, target, b, cost, low):
    """Fill (n, m) squared distances of (3, n) points and the first three rows of `target`.

    Also fills low_i = min_j (c_ij + b_j): each row is read while it is in the cache.
    """
    u, v, w = target[0], target[1], target[2]
    for i in range(cost.shape[0]):
        x, y, z = np.float32(moved[0, i]), np.float32(moved[1, i]), np.float32(moved[2, i])
        row, best = cost[i], _NONE
        for j in range(cost.shape[1]):
            p, q, r = x - u[j], y - v[j], z - w[j]
            row[j] = p * p + q * q + r * r
            best = min(best, np.float32(row[j] + b[j]).view(np.int32))
        low[i] = np.int32(best).view(np.float32)


@jit_reduction
def rough_minima(cost, b, low):
    """Fill low_i = min_j (c_ij + b_j)."""
    for i in range(cost.shape[0]):
        row, best = cost[i], _NONE
        for j in range(cost.shape[1]):
            best = min(best, np.float32(row[j] + b[j]).view(np.int32))
        low[i] = np.int32(best).view(np.float32)


@jit_reduction
def lower_duals(cost, low, ceiling, b):
    """Lower the duals as far as no row minimum up to `ceiling` decreases.

    Duals from another pose that support no row minimum decrease. `low` is clipped at the ceiling, above
    which it is no longer valid.
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
def _two_cheapest(row, b, places, totals):
    """Return the cheapest column of a row, and the truncated totals of the two cheapest.

    The last bits of each total hold its column, so one minimum gives both.
    """
    first = second = _NONE
    for j in range(b.size):
        totals[j] = (np.float32(row[j] + b[j]).view(np.int32) & ~places) | np.int32(j)
        first = min(first, totals[j])
    for j in range(b.size):
        second = min(second, totals[j] if totals[j] != first else _NONE)
    one = np.int32(first & ~places).view(np.float32)
    return first & places, one, np.int32(second & ~places).view(np.float32)


class Auction(NamedTuple):
    """Limits of an auction.

    Attributes
    ----------
    steps : int
        Maximum number of steps.
    level : float
        Rows that cost more than this remain unmatched.
    step : float
        Minimum raise of a dual.
    """

    steps: int
    level: float
    step: float


@jit_inner
def auction(cost, b, low, limits, integers):
    """Raise duals by auction steps.

    `low` holds the row minima under the duals; `integers` is a (3, max(n, m)) int32 array.
    """
    queue, owner, totals = integers[0], integers[1], integers[2]
    left, n = limits.steps, low.size
    places, size = np.int32(1), 0
    while places < b.size:
        places *= np.int32(2)
    places -= np.int32(1)
    for i in range(n):
        if low[i] <= limits.level:
            queue[size] = i
            size += 1
    for j in range(b.size):
        owner[j] = -1
    head, tail = 0, size if size < n else 0
    while size > 0 and left > 0:
        i = queue[head]
        head = head + 1 if head + 1 < n else 0
        size -= 1
        left -= 1
        at, first, second = _two_cheapest(cost[i], b, places, totals)
        if first > limits.level:
            continue
        loser = owner[at]
        owner[at] = i
        if loser >= 0 or b[at] > _ZERO:
            b[at] += min(second, limits.level) - first + limits.step
        if loser >= 0:
            queue[tail] = loser
            tail = tail + 1 if tail + 1 < n else 0
            size += 1
