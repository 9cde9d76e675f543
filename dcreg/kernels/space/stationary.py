"""What the matchings at the centre of a box say of optima elsewhere in it, from their being stationary.

Why it holds is written in `dcreg.bounds.rigid3d`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.kernels.assignment.selection import smallest_sum, total
from dcreg.kernels.compiling import jit, jit_reduction


class Loss(NamedTuple):
    """What an optimum may cost less than its matching does at the centre of a box.

    With C the least of ``sum (cost - |way|^2)`` over the matchings and the corners of the box, every
    optimum E* in it has ``E* + root * sqrt(E*) + rest >= C``.

    Attributes
    ----------
    root, rest : float
    """

    root: float
    rest: float


@jit
def loss_of(tangent, slack, inertia, drift):
    """The loss of third order in a box whose Gibbs vectors reach `tangent` and shifts `slack`.

    `inertia` is the greatest sum of squares of any k sources, `drift` the greatest length of their sum.
    """
    square = tangent * tangent
    return Loss(
        4.0 * square / (1.0 + square) * math.sqrt(inertia),
        4.0 * square / math.sqrt(1.0 + square) * slack * drift,
    )


@jit
def needed(loss, cutoff):
    """The C that proves `cutoff`."""
    cutoff = max(0.0, cutoff)
    root = loss.root * math.sqrt(cutoff) if loss.root > 0.0 else 0.0
    return cutoff + root + loss.rest


@jit
def proven(loss, least):
    """The bound on E* that C = `least` proves."""
    rest = least - loss.rest
    return (0.5 * (math.sqrt(loss.root**2 + 4.0 * rest) - loss.root)) ** 2 if rest > 0.0 else 0.0


class Ways(NamedTuple):
    """Room for the ways of all source points to a corner of a box: (n,) arrays."""

    u: np.ndarray
    v: np.ndarray
    w: np.ndarray
    net: np.ndarray


@jit
def room_for_ways(n):
    return Ways(np.empty(n), np.empty(n), np.empty(n), np.empty(n))


@jit_reduction
def _turn(moved, p, q, r, low, ways):
    """Ways by a rotation alone, and what they leave of `low`."""
    x, y, z = moved[0], moved[1], moved[2]
    u, v, w, net = ways
    for i in range(low.size):
        u[i], v[i], w[i] = q * z[i] - r * y[i], r * x[i] - p * z[i], p * y[i] - q * x[i]
        net[i] = low[i] - (u[i] * u[i] + v[i] * v[i] + w[i] * w[i])


@jit_reduction
def _depths(ways, a, b, c, level):
    """How far all net costs lie below a level, at a shift and at its opposite."""
    u, v, w, net = ways
    one = other = 0.0
    for i in range(net.size):
        cross, below = a * u[i] + b * v[i] + c * w[i], level - net[i]
        one += max(below + cross, 0.0)
        other += max(below - cross, 0.0)
    return one, other


@jit
def least_at_corners(moved, low, k, corners, half, level, ways):
    """C of `Loss` less the prices, from below, for rows that cost at least `low`.

    The least is at corners, since ways are linear in (r, s): turned by Gibbs vector r and shifted by s, a
    point x goes the way 2 r x x + s. The sum of the k smallest numbers is at least
    ``k level - sum max(0, level - number)`` at any level: one that is best for one corner does for all.
    """
    square = half[0] ** 2 + half[1] ** 2 + half[2] ** 2
    least = np.inf
    for a in range(corners.shape[0]):
        _turn(moved, 2.0 * corners[a, 0], 2.0 * corners[a, 1], 2.0 * corners[a, 2], low, ways)
        if a == 0 or k == low.size:
            spacing = 0.02 * (abs(level) + abs(total(ways.net)) / low.size)
            found, level = smallest_sum(ways.net, k, level, spacing)
        if k == low.size:  # all rows are matched: the shifts of all add up
            least = min(least, found - 2.0 * _drift(ways, half))
            continue
        for sign in range(4):
            b = 2.0 * half[1] * (1.0 - (sign & 1) * 2.0)
            c = 2.0 * half[2] * (1.0 - (sign & 2))
            one, other = _depths(ways, 2.0 * half[0], b, c, level)
            least = min(least, k * level - max(one, other))
    return least - k * square


@jit
def _drift(ways, half):
    """The greatest inner product of a shift with the sum of all ways."""
    u = v = w = 0.0
    for i in range(ways.u.size):
        u += ways.u[i]
        v += ways.v[i]
        w += ways.w[i]
    return half[0] * abs(u) + half[1] * abs(v) + half[2] * abs(w)
