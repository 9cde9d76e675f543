"""The problem as kernels receive it, and a score of poses by the distance to the target."""

from __future__ import annotations

import math
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


class NearnessField(NamedTuple):
    """Nearness of the cells of a cube to the target; one layer of cells in 2D.

    Attributes
    ----------
    origin : (3,) array
        The minimum vertex of the cube.
    cell : float
        Side of a cell.
    values : (a, b, c) array
        ``max(0, 1 - (d / reach)^2)``, d from the centre of the cell to the nearest point.
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
                    near = 1.0 - (d0 * d0 + d1 * d1 + d2 * d2) / (reach * reach)
                    if near > values[i0, i1, i2]:
                        values[i0, i1, i2] = near


@jit_part
def overlap(R, t, points, field, floor, n_first, share):
    """Return the summed nearness of the moved points; incomplete if it cannot exceed `floor`.

    The sum also ends early if the first `n_first` points score less than their part of `share` of
    `floor`.
    """
    n, cell, origin = points.shape[0], field.cell, field.origin
    n0, n1, n2 = field.values.shape
    score = 0.0
    for i in range(n):
        u, v, w = points[i, 0], points[i, 1], points[i, 2]
        a = math.floor((R[0, 0] * u + R[0, 1] * v + R[0, 2] * w + t[0] - origin[0]) / cell)
        b = math.floor((R[1, 0] * u + R[1, 1] * v + R[1, 2] * w + t[1] - origin[1]) / cell)
        c = math.floor((R[2, 0] * u + R[2, 1] * v + R[2, 2] * w + t[2] - origin[2]) / cell)
        if 0 <= a < n0 and 0 <= b < n1 and 0 <= c < n2:
            score += field.values[a, b, c]
        if score + (n - 1 - i) <= floor:
            return score
        if i == n_first and score < share * floor * (i + 1) / n:
            return 0.0
    return score
