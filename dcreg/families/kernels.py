"""The problem as kernels receive it, and a score of poses by the distance to the target."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.jit import jit, jit_part


class Clouds(NamedTuple):
    """Both clouds of a problem, by axis, with the other inputs of its kernels.

    Attributes
    ----------
    source : (d, n) array
    target : (d, m) array, or (m,) array of norms
        When a kernel is compiled, the number of dimensions distinguishes norms from points.
    infeasibility_penalty : (n, m) array, or (0, 0) if every pair is feasible
        Cost of a pair in addition to its squared residual: 0, or a penalty if the pair is infeasible or
        light.
    weights : (n, m) array, or (0, 0) if all are 1
        Factors between 0 and 1 of the costs of pairs, `infeasibility_penalty` included.
    heaviest : (n,) array
        The maximum weight of the pairs of each source point.
    k : int
        Number of pairs to match.
    stop : (1,) uint8 array
        Another thread sets it; a kernel then returns at once, with incomplete output.
    """

    source: np.ndarray
    target: np.ndarray
    infeasibility_penalty: np.ndarray
    weights: np.ndarray
    heaviest: np.ndarray
    k: int
    stop: np.ndarray


@jit_part
def add_penalty(penalty, costs):
    """Add the penalties of infeasible pairs to (n, m) costs; nothing if `penalty` is empty."""
    for i in range(penalty.shape[0]):
        for j in range(penalty.shape[1]):
            costs[i, j] += penalty[i, j]


@jit_part
def weigh(weights, costs):
    """Multiply (n, m) costs by the weights of pairs; nothing if `weights` is empty."""
    for i in range(weights.shape[0]):
        for j in range(weights.shape[1]):
            costs[i, j] *= weights[i, j]


NEAREST = 255.0  # the nearness of a cell at a point


class NearnessField(NamedTuple):
    """Nearness of the cells of a cube to the target; one layer of cells in 2D.

    Attributes
    ----------
    origin : (3,) array
        The minimum vertex of the cube.
    cell : float
        Side of a cell.
    values : (a, b, c) uint8 array
        ``max(0, 1 - (d / reach)^2)``, d from the centre of the cell to the nearest point, in steps of
        1 / `NEAREST`. Small values, because the score of a pose looks at random cells.
    """

    origin: np.ndarray
    cell: float
    values: np.ndarray


@jit
def fill_nearness(points, reach, field):
    """Fill a `NearnessField` of zeros for (m, 3) points."""
    cell, values = field.cell, field.values
    span = int(reach / cell) + 1
    n0, n1, n2 = values.shape
    for j in range(points.shape[0]):
        x, y = points[j, 0] - field.origin[0], points[j, 1] - field.origin[1]
        z = points[j, 2] - field.origin[2]
        a, b, c = int(x / cell), int(y / cell), int(z / cell)
        for i0 in range(max(0, a - span), min(n0, a + span + 1)):
            d0 = (i0 + 0.5) * cell - x
            for i1 in range(max(0, b - span), min(n1, b + span + 1)):
                d1 = (i1 + 0.5) * cell - y
                for i2 in range(max(0, c - span), min(n2, c + span + 1)):
                    d2 = (i2 + 0.5) * cell - z
                    near = NEAREST * (1.0 - (d0 * d0 + d1 * d1 + d2 * d2) / (reach * reach))
                    if near > values[i0, i1, i2]:
                        values[i0, i1, i2] = np.uint8(near)


_DEVIATIONS = 1.5  # below its expected value, at which a sum ends


@jit_part
def overlap(R, t, points, field, floor):
    """Return the summed nearness of the moved points; 0 if it is unlikely to exceed `floor`.

    The points are in random order. If the sum of all n values in [0, 1] is `floor`, with mean f, the sum
    of the first i has the mean f i and a variance of at most f (1 - f) i (1 - i / n). The sum ends if it
    is more than `_DEVIATIONS` standard deviations below (a sequential test as in Matas and Chum 2005).
    """
    n, origin, per_cell = points.shape[0], field.origin, 1.0 / field.cell
    n0, n1, n2 = field.values.shape
    mean = NEAREST * floor / n
    spread = _DEVIATIONS * _DEVIATIONS * mean * (NEAREST - mean) / n
    # from a point to its cell, in cells
    r00, r01, r02 = R[0, 0] * per_cell, R[0, 1] * per_cell, R[0, 2] * per_cell
    r10, r11, r12 = R[1, 0] * per_cell, R[1, 1] * per_cell, R[1, 2] * per_cell
    r20, r21, r22 = R[2, 0] * per_cell, R[2, 1] * per_cell, R[2, 2] * per_cell
    s0, s1 = (t[0] - origin[0]) * per_cell, (t[1] - origin[1]) * per_cell
    s2 = (t[2] - origin[2]) * per_cell
    score = 0.0
    for i in range(n):
        u, v, w = points[i, 0], points[i, 1], points[i, 2]
        a = r00 * u + r01 * v + r02 * w + s0
        b = r10 * u + r11 * v + r12 * w + s1
        c = r20 * u + r21 * v + r22 * w + s2
        if 0.0 <= a < n0 and 0.0 <= b < n1 and 0.0 <= c < n2:
            score += field.values[np.uintp(int(a)), np.uintp(int(b)), np.uintp(int(c))]
        short = mean * (i + 1) - score
        if short > 0.0 and short * short > spread * (i + 1) * (n - 1 - i):
            return 0.0
    return score / NEAREST
