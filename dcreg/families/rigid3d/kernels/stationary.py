"""Bounds on the optima of a box from the matchings at its centre: optima are stationary.

The proof is in `dcreg.families.rigid3d.bound`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import least, smallest_sum, total
from dcreg.jit import jit, jit_part, jit_reduction


class Loss(NamedTuple):
    """How much an optimum may cost less than its matching costs at the centre of a box.

    Let C be the minimum of ``sum (cost - |displacement|^2)`` over the matchings and the vertices of the
    box. Every optimum E* in the box then has ``E* + root * sqrt(E*) + rest >= C``.

    Attributes
    ----------
    root, rest : float
    """

    root: float
    rest: float


class BoxGeometry(NamedTuple):
    """A box relative to its centre.

    Attributes
    ----------
    vertices : (a, 3) array
        Gibbs vectors of the vertices of its rotations.
    half : (3,) array
        Half its widths in translation.
    tangent, slack : float
        The largest length of a Gibbs vector, and of a shift.
    """

    vertices: np.ndarray
    half: np.ndarray
    tangent: float
    slack: float


class Limits(NamedTuple):
    """Upper bounds for a matching of k source points.

    Attributes
    ----------
    inertia : float
        On the sum of their squares.
    drift : float
        On the length of their sum.
    spread : float
        On the difference of two eigenvalues of their second moments.
    """

    inertia: float
    drift: float
    spread: float


@jit_part
def loss_of(box, limits):
    """The loss of third order in a box."""
    square = box.tangent * box.tangent
    return Loss(
        4.0 * square / (1.0 + square) * math.sqrt(limits.inertia),
        4.0 * square / math.sqrt(1.0 + square) * box.slack * limits.drift,
    )


@jit_part
def joint_loss_of(box, limits):
    """The loss of the mean of C at a vertex and the minimum sum of costs there."""
    square = box.tangent * box.tangent
    return Loss(
        2.0 * square * math.sqrt(limits.inertia),
        2.0 * square / math.sqrt(1.0 + square) * box.slack * limits.drift
        + 0.77 * square * box.tangent * limits.spread
        + 0.5 * square * square * limits.inertia,
    )


@jit_part
def needed(root, rest, cutoff):
    """The C that proves `cutoff`, with the terms of a `Loss`."""
    cutoff = max(0.0, cutoff)
    lost = root * math.sqrt(cutoff) if root > 0.0 else 0.0
    return cutoff + lost + rest


@jit_part
def proven(root, rest, cost):
    """The bound on E* that C = `cost` proves."""
    left = cost - rest
    return (0.5 * (math.sqrt(root * root + 4.0 * left) - root)) ** 2 if left > 0.0 else 0.0


@jit_reduction
def _turn(moved, p, q, r, low, work):
    """Displacements by a rotation into rows 1 to 3 of `work`, and `low` less their squares into row 4."""
    x, y, z = moved[0], moved[1], moved[2]
    u, v, w, net = work[1], work[2], work[3], work[4]
    for i in range(low.size):
        u[i], v[i], w[i] = q * z[i] - r * y[i], r * x[i] - p * z[i], p * y[i] - q * x[i]
        net[i] = low[i] - (u[i] * u[i] + v[i] * v[i] + w[i] * w[i])


@jit_reduction
def _depths(work, a, b, c, level):
    """How far all net costs lie below a level, at a shift and at its opposite."""
    u, v, w, net = work[1], work[2], work[3], work[4]
    one = other = 0.0
    for i in range(net.size):
        cross, below = a * u[i] + b * v[i] + c * w[i], level - net[i]
        one += max(below + cross, 0.0)
        other += max(below - cross, 0.0)
    return one, other


@jit
def costs_at_vertices(moved, low, k, box, level, work, out):
    """Lower bounds on C of `Loss` at every vertex of a box, for rows that cost at least `low`.

    Returns the minimum. It is the minimum over the box, since displacements are linear in (r, s): turned
    by Gibbs vector r and shifted by s, a point x moves by 2 r x x + s. The sum of the k smallest numbers
    is at least ``k level - sum max(0, level - number)`` at any level: one that is best for one vertex
    serves all.

    Entry 8 a + s of `out` is that of the rotation vertex a and the shift s, whose three bits mark
    negative axes; +inf where there is no such vertex. `work` is (5, n); row 0 is left as it is.
    """
    vertices, half, n = box.vertices, box.half, low.size
    square = k * (half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    for at in range(out.size):
        out[at] = np.inf
    found = u = v = w = 0.0
    for a in range(vertices.shape[0]):
        _turn(moved, 2.0 * vertices[a, 0], 2.0 * vertices[a, 1], 2.0 * vertices[a, 2], low, work)
        if a == 0 or k == n:
            spacing = 0.02 * (abs(level) + abs(total(work[4])) / n)
            found, level = smallest_sum(work[4], k, level, spacing)
        if k == n:  # all rows are matched: the shifts of all add up
            u, v, w = total(work[1]), total(work[2]), total(work[3])
        for sign in range(4):
            x, y, z = half[0], half[1] * (1.0 - 2.0 * (sign & 1)), half[2] * (1.0 - (sign & 2))
            if k == n:
                cross = 2.0 * (x * u + y * v + z * w)
                one, other = found - cross, found + cross
            else:
                depths = _depths(work, 2.0 * x, 2.0 * y, 2.0 * z, level)
                one, other = k * level - depths[0], k * level - depths[1]
            out[8 * a + 2 * sign] = one - square
            out[8 * a + 7 - 2 * sign] = other - square
    return least(out)
