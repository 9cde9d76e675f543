"""What the matchings at the centre of a box say of optima elsewhere in it, from their being stationary.

Why it holds is written in `dcreg.families.rigid3d.bound`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import least, smallest_sum, total
from dcreg.jit import jit, jit_reduction


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


class Surroundings(NamedTuple):
    """A box as seen from its centre.

    Attributes
    ----------
    corners : (a, 3) array
        Gibbs vectors of the corners of its rotations.
    half : (3,) array
        Half its widths in translation.
    tangent, slack : float
        The greatest length of a Gibbs vector, and of a shift.
    """

    corners: np.ndarray
    half: np.ndarray
    tangent: float
    slack: float


class Limits(NamedTuple):
    """What a matching of k sources has at most.

    Attributes
    ----------
    inertia : float
        The sum of their squares.
    drift : float
        The length of their sum.
    spread : float
        The difference of two eigenvalues of their second moments.
    """

    inertia: float
    drift: float
    spread: float


@jit
def loss_of(box, limits):
    """The loss of third order in a box."""
    square = box.tangent**2
    return Loss(
        4.0 * square / (1.0 + square) * math.sqrt(limits.inertia),
        4.0 * square / math.sqrt(1.0 + square) * box.slack * limits.drift,
    )


@jit
def joint_loss_of(box, limits):
    """The loss of the mean of C at a corner and the least sum of costs there."""
    square = box.tangent**2
    return Loss(
        2.0 * square * math.sqrt(limits.inertia),
        2.0 * square / math.sqrt(1.0 + square) * box.slack * limits.drift
        + 0.77 * square * box.tangent * limits.spread
        + 0.5 * square * square * limits.inertia,
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
def look_at_corners(moved, low, k, corners, half, level, ways, out):
    """C of `Loss` at every corner of a box, from below, for rows that cost at least `low`; the least.

    It is the least in the box, since ways are linear in (r, s): turned by Gibbs vector r and shifted by
    s, a point x goes the way 2 r x x + s. The sum of the k smallest numbers is at least
    ``k level - sum max(0, level - number)`` at any level: one that is best for one corner does for all.

    Entry 8 a + s of `out` is that of the rotation corner a and the shift s, the three bits of which tell
    where it is negative; +inf where there is no such corner.
    """
    square = k * (half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    out[:] = np.inf
    for a in range(corners.shape[0]):
        _turn(moved, 2.0 * corners[a, 0], 2.0 * corners[a, 1], 2.0 * corners[a, 2], low, ways)
        if a == 0 or k == low.size:
            spacing = 0.02 * (abs(level) + abs(total(ways.net)) / low.size)
            found, level = smallest_sum(ways.net, k, level, spacing)
        if k == low.size:  # all rows are matched: the shifts of all add up
            u, v, w = total(ways.u), total(ways.v), total(ways.w)
        for sign in range(4):
            x, y, z = half[0], half[1] * (1.0 - 2.0 * (sign & 1)), half[2] * (1.0 - (sign & 2))
            if k == low.size:
                cross = 2.0 * (x * u + y * v + z * w)
                one, other = found - cross, found + cross
            else:
                depths = _depths(ways, 2.0 * x, 2.0 * y, 2.0 * z, level)
                one, other = k * level - depths[0], k * level - depths[1]
            out[8 * a + 2 * sign] = one - square
            out[8 * a + 7 - 2 * sign] = other - square
    return least(out)
