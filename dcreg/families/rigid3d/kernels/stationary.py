"""Bounds on the optima of a box, which are stationary, from the matchings at its centre.

The proof is in `dcreg.families.rigid3d.bound`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import least, smallest_sum, total
from dcreg.jit import jit_inner, jit_part, jit_reduction

_STEPS = 16  # of the grid in `largest_rest`


class Loss(NamedTuple):
    """Bound on the difference between an optimum and the cost of its matching at the centre of a box.

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
    tangent : float
        The maximum length of a Gibbs vector: the tangent of half the maximum rotation angle.
    shift_radius : float
        The maximum length of a shift, in RMS radii of the target.
    """

    vertices: np.ndarray
    half: np.ndarray
    tangent: float
    shift_radius: float


class Limits(NamedTuple):
    """Upper bounds for a matching of k source points.

    Attributes
    ----------
    inertia : float
        On the sum of their squared norms.
    drift : float
        On the norm of their sum.
    spread : float
        On the difference of two eigenvalues of their second moments.
    """

    inertia: float
    drift: float
    spread: float


@jit_part
def loss_of(box, limits):
    """Return the third-order loss in a box."""
    square = box.tangent * box.tangent
    return Loss(
        4.0 * square / (1.0 + square) * math.sqrt(limits.inertia),
        4.0 * square / math.sqrt(1.0 + square) * box.shift_radius * limits.drift,
    )


@jit_part
def joint_loss_of(box, limits):
    """Return the loss of the mean of C at a vertex and the minimum sum of costs there."""
    square = 2.0 * box.tangent * box.tangent
    drift = square * box.shift_radius * limits.drift
    spread, inertia = square * box.tangent * limits.spread, 0.5 * square * square * limits.inertia
    return Loss(square * math.sqrt(limits.inertia), largest_rest(drift, spread, inertia))


@jit_part
def largest_rest(drift, spread, inertia):
    """Bound drift u^2 + (spread u + inertia u^2) (1 - u^2) from above for u in [0, 1].

    Between two points of a grid, the function exceeds the greater of its values there by at most the
    squared step times an eighth of its greatest curvature downwards.
    """
    found, step = drift, 1.0 / _STEPS
    for at in range(_STEPS):
        u = at * step
        found = max(found, drift * u * u + (spread * u + inertia * u * u) * (1.0 - u * u))
    return found + 0.125 * step * step * (6.0 * spread + 10.0 * inertia)


@jit_part
def needed(root, rest, cutoff):
    """Return the C that proves `cutoff`, with the terms of a `Loss`."""
    cutoff = max(0.0, cutoff)
    lost = root * math.sqrt(cutoff) if root > 0.0 else 0.0
    return cutoff + lost + rest


@jit_part
def proven(root, rest, cost):
    """Return the bound on E* that C = `cost` proves."""
    left = cost - rest
    return (0.5 * (math.sqrt(root * root + 4.0 * left) - root)) ** 2 if left > 0.0 else 0.0


@jit_reduction
def _displace(moved, heaviest, gibbs, square, low, work):
    """Write displacements by a rotation to rows 1 to 3 of `work`, `low` minus their squares to row 4.

    Both are multiplied by the weights `heaviest`; of the `square` of a shift, the missing part is added.
    """
    x, y, z, p, q, r = moved[0], moved[1], moved[2], 2.0 * gibbs[0], 2.0 * gibbs[1], 2.0 * gibbs[2]
    u, v, w, net = work[1], work[2], work[3], work[4]
    for i in range(low.size):
        a, b, c, weight = q * z[i] - r * y[i], r * x[i] - p * z[i], p * y[i] - q * x[i], heaviest[i]
        u[i], v[i], w[i] = weight * a, weight * b, weight * c
        net[i] = low[i] - weight * (a * a + b * b + c * c) + (1.0 - weight) * square


@jit_reduction
def _depths(work, a, b, c, level):
    """Return the summed depths of all net costs below a level, for a shift and its opposite."""
    u, v, w, net = work[1], work[2], work[3], work[4]
    one = other = 0.0
    for i in range(net.size):
        cross, below = a * u[i] + b * v[i] + c * w[i], level - net[i]
        one += max(below + cross, 0.0)
        other += max(below - cross, 0.0)
    return one, other


@jit_inner
def costs_at_vertices(view, low, box, level, work, out):
    """Fill lower bounds on C of `Loss` at each vertex of a box, for rows that cost at least `low`.

    Returns their minimum, which is also the minimum over the box, because displacements are linear in
    (r, s): a rotation with Gibbs vector r and a shift s move a point x by 2 r x x + s. The sum of the k
    smallest numbers is at least ``k level - sum max(0, level - number)`` for any level. The best level
    of one vertex serves all vertices. Displacements have the maximum weights of the source points.

    Entry 8 a + s of `out` is that of the rotation vertex a and the shift s, whose three bits mark
    negative axes; +inf if there is no such vertex. `work` is (5, n); row 0 is not changed.
    """
    vertices, half, n, k = box.vertices, box.half, low.size, view.k
    shift = half[0] ** 2 + half[1] ** 2 + half[2] ** 2
    square = k * shift
    for at in range(out.size):
        out[at] = np.inf
    found = u = v = w = 0.0
    for a in range(vertices.shape[0]):
        _displace(view.source, view.heaviest, vertices[a], shift, low, work)
        if a == 0 or k == n:
            spacing = 0.02 * (abs(level) + abs(total(work[4])) / n)
            found, level = smallest_sum(work[4], k, level, spacing)
        if k == n:  # all rows are matched, so the shifts of all rows add up
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
