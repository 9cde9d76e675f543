"""Poses from similar triples: initial poses of a similarity search if many points have no partner.

A similarity preserves ratios of distances. Three source points and three target points with nearly the
same ratios determine a pose. Its score is the number of source points near the target. Point sets are
stored by row, (n, 3) and (m, 3).
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.selection import cleared
from dcreg.families.rigid3d.kernels.congruent import (
    N_BEST,
    complete,
    direction,
    first_at_least,
    frame,
    keep_best,
    offer,
    place,
)
from dcreg.jit import jit


@jit
def similar_triple_poses(triples, sides, clouds, feasible, pairs, search, poses, scores):
    """Find the best poses of each source triple; return the number of target triples tried.

    Parameters
    ----------
    triples : (T, 3) int array
    sides : (T, 5) array
        Distances of the first to the second, of the first to the third and of the second to the third
        point; then the range of the target pairs that an admissible scale makes of the first side.
    clouds, feasible, pairs
        As in `dcreg.families.rigid3d.kernels.congruent.triple_poses`.
    search : (tolerance, looked, field, stop)
        Tolerance of a distance, the source points used for the score, the `NearnessField` of the
        target, and the stop flag.
    poses, scores : (T, K, 3, 4), (T, K) arrays
        Receive the best poses of each triple; scores are initially zero.

    Returns
    -------
    int
        Target triples tried.
    """
    source, target = clouds
    first, second, distances, order, ascending = pairs
    tolerance, looked, field, stop = search
    F, G, R, t = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    centroid, middle, best = np.empty(3), np.empty(3), cleared(np.empty(N_BEST))
    tried, least = 0, 0.0
    for at in range(triples.shape[0]):
        u, v, w = triples[at, 0], triples[at, 1], triples[at, 2]
        p, q, r = source[u], source[v], source[w]
        if at > 0:
            least = keep_best(scores[at - 1], best)
        if not frame(p, q, r, F):
            continue
        for a in range(3):
            centroid[a] = (p[a] + q[a] + r[a]) / 3.0
        pq, pr, qr = sides[at, 0], sides[at, 1], sides[at, 2]
        for pair in range(int(sides[at, 3]), int(sides[at, 4])):
            if stop[0]:
                return tried
            i, j = first[pair], second[pair]
            if feasible.size > 0 and not (feasible[u, i] and feasible[v, j]):
                continue
            if not direction(target[i], target[j], G):
                continue
            ratio = distances[i, j] / pq
            far_pr = ratio * pr + tolerance
            near = first_at_least(ascending[i], ratio * pr - tolerance)
            for rank in range(near, target.shape[0]):
                if ascending[i, rank] > far_pr:
                    break
                k = order[i, rank]
                if abs(ratio * qr - distances[j, k]) > tolerance or k in (i, j):
                    continue
                if feasible.size > 0 and not feasible[w, k]:
                    continue
                if not complete(target[i], target[k], G):
                    continue
                tried += 1
                scale = (distances[i, j] + distances[i, k] + distances[j, k]) / (pq + pr + qr)
                for a in range(3):
                    middle[a] = (target[i, a] + target[j, a] + target[k, a]) / 3.0
                place(F, G, scale, centroid, middle, R, t)
                # a smaller source is near the target more often by chance
                offer(R, t, math.sqrt(scale), looked, field, least, scores[at], poses[at])
    return tried
