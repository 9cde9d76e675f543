"""Similarities of the plane that map two source points onto two target points.

They are scored by how many source points they bring near the target. Point sets are stored by row, (n, 2)
and (m, 2).
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.jit import jit

_FIRST_LOOK = 10  # source points after which a pose is dropped that scores less than ...
_FIRST_SHARE = 0.4  # ... this share of what the poses kept so far score there on average


@jit
def nearness_field(points, origin, cell, reach, field):
    """field[cell] = max(0, 1 - (d / reach)^2), d from the cell's centre to the nearest point.

    `field` comes as zeros.
    """
    span = int(reach / cell) + 1
    shape = field.shape[0]
    for j in range(points.shape[0]):
        x, y = points[j, 0] - origin[0], points[j, 1] - origin[1]
        a, b = int(x / cell), int(y / cell)
        for i0 in range(max(0, a - span), min(shape, a + span + 1)):
            d0 = (i0 + 0.5) * cell - x
            for i1 in range(max(0, b - span), min(shape, b + span + 1)):
                d1 = (i1 + 0.5) * cell - y
                near = 1.0 - (d0 * d0 + d1 * d1) / (reach * reach)
                if near > field[i0, i1]:
                    field[i0, i1] = near


@jit
def overlap(theta, points, origin, cell, field, floor):
    """Sum of nearness of the moved points; gives up where even a perfect rest stays below `floor`."""
    shape, n = field.shape[0], points.shape[0]
    a, b, tx, ty = theta[0], theta[1], theta[2] - origin[0], theta[3] - origin[1]
    score = 0.0
    for i in range(n):
        u, v = points[i, 0], points[i, 1]
        row = math.floor((a * u - b * v + tx) / cell)
        column = math.floor((b * u + a * v + ty) / cell)
        if 0 <= row < shape and 0 <= column < shape:
            score += field[row, column]
        if score + (n - 1 - i) <= floor:
            return score
        if i == _FIRST_LOOK and score < _FIRST_SHARE * floor * (i + 1) / n:
            return 0.0
    return score


@jit
def pair_poses(pairs, source, target, feasible, search, thetas, scores):
    """The best poses of every source pair, each from one of the target pairs.

    Parameters
    ----------
    pairs : (P, 2) int array
        Rows of distinct source points.
    source, target : (n, 2), (m, 2) arrays
    feasible : (n, m) or (0, 0) bool array
        Which points may be matched; empty: all.
    search : (looked, origin, cell, field, low, high, stop)
        The source points that score, the field of `nearness_field`, the range of scales, and what ends
        the kernel early once it is set.
    thetas, scores : (P, K, 4), (P, K) arrays
        Receive the best poses of each pair; scores come as zeros.
    """
    looked, origin, cell, field, low, high, stop = search
    theta = np.empty(4)
    for at in range(pairs.shape[0]):
        i, j = pairs[at, 0], pairs[at, 1]
        x, y = source[j, 0] - source[i, 0], source[j, 1] - source[i, 1]
        square = x * x + y * y
        middle_x, middle_y = (
            0.5 * (source[i, 0] + source[j, 0]),
            0.5 * (source[i, 1] + source[j, 1]),
        )
        for p in range(target.shape[0]):
            if stop[0]:
                return
            if feasible.size > 0 and not feasible[i, p]:
                continue
            for q in range(target.shape[0]):
                if q == p or (feasible.size > 0 and not feasible[j, q]):
                    continue
                u, v = target[q, 0] - target[p, 0], target[q, 1] - target[p, 1]
                other = u * u + v * v
                if other < low * low * square or other > high * high * square:
                    continue
                # the complex number (u + iv) / (x + iy) turns and scales one pair into the other
                a, b = (u * x + v * y) / square, (v * x - u * y) / square
                theta[0], theta[1] = a, b
                theta[2] = 0.5 * (target[p, 0] + target[q, 0]) - (a * middle_x - b * middle_y)
                theta[3] = 0.5 * (target[p, 1] + target[q, 1]) - (b * middle_x + a * middle_y)
                worst = 0
                for kept in range(1, scores.shape[1]):
                    if scores[at, kept] < scores[at, worst]:
                        worst = kept
                # a shrunken source comes near more by chance
                weight = math.sqrt(math.sqrt(other / square))
                floor = scores[at, worst] / weight
                score = weight * overlap(theta, looked, origin, cell, field, floor)
                if score > scores[at, worst]:
                    scores[at, worst] = score
                    for c in range(4):
                        thetas[at, worst, c] = theta[c]
