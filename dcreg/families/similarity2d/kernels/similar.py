"""Similarities in 2D that map two source points onto two target points.

Their score is the number of source points near the target. Point sets are stored by row, (n, 2) and (m,
2).
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.selection import cleared
from dcreg.families.kernels import overlap
from dcreg.jit import jit

_N_FIRST = 10  # source points after which a pose is dropped if it scores less than ...
_FIRST_SHARE = 0.4  # ... this share of the average score of the stored poses at this point


@jit
def pair_poses(pairs, source, target, feasible, search, thetas, scores):
    """Find the best poses of each source pair over the target pairs.

    Parameters
    ----------
    pairs : (P, 2) int array
        Rows of distinct source points.
    source, target : (n, 2), (m, 2) arrays
    feasible : (n, m) or (0, 0) bool array
        Feasible pairs; empty: all.
    search : (looked, field, low, high, stop)
        The (n, 3) source points used for the score, the `NearnessField` of the target, the range of
        scales, and the stop flag.
    thetas, scores : (P, K, 4), (P, K) arrays
        Receive the best poses of each pair; scores are initially zero.
    """
    looked, field, low, high, stop = search
    theta, R, t = np.empty(4), cleared(np.empty((3, 3))), cleared(np.empty(3))
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
                # the complex number (u + iv) / (x + iy) rotates and scales one pair into the other
                a, b = (u * x + v * y) / square, (v * x - u * y) / square
                theta[0], theta[1] = a, b
                theta[2] = 0.5 * (target[p, 0] + target[q, 0]) - (a * middle_x - b * middle_y)
                theta[3] = 0.5 * (target[p, 1] + target[q, 1]) - (b * middle_x + a * middle_y)
                worst = 0
                for kept in range(1, scores.shape[1]):
                    if scores[at, kept] < scores[at, worst]:
                        worst = kept
                # a smaller source is near the target more often by chance
                weight = math.sqrt(math.sqrt(other / square))
                floor = scores[at, worst] / weight
                R[0, 0], R[0, 1], R[1, 0], R[1, 1] = a, -b, b, a
                t[0], t[1] = theta[2], theta[3]
                score = weight * overlap(R, t, looked, field, floor, _N_FIRST, _FIRST_SHARE)
                if score > scores[at, worst]:
                    scores[at, worst] = score
                    for c in range(4):
                        thetas[at, worst, c] = theta[c]
