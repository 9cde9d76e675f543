"""What is kept of a vertex in the plane: its value, and a profile that bounds it under any row charges.

With duals b >= 0 let r_i = min_j (c_ij + b_j) - (sum b) / k, the *profile*. For any charge R_i on the
rows the sum of the k smallest r_i - R_i is at most the k-assignment of c_ij - R_i, whatever b. With
optimal b the k smallest r_i add up to E(v).
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import first_prices, improve_assignment, row_minima
from dcreg.assignment.kernels.selection import least, smallest_sum, total
from dcreg.families.dc.kernels.motion import pair_costs
from dcreg.jit import jit

# Added to the squared distance of a vertex that was not solved: any solved one counts for more.
_UNSOLVED = 1e6


@jit
def solve_vertices(clouds, known, warm, slots):
    """E at the vertices `slots`, with optimal duals and profile. Returns the assignments spent.

    With `warm` the duals already there are the start.
    """
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    cost = np.empty((n, m))
    for at in range(slots.size):
        if clouds.stop[0]:
            break
        slot = slots[at]
        duals = known.duals[slot]
        pair_costs(clouds, known.thetas[slot], cost)
        if not warm:
            first = first_prices(cost, clouds.k)
            for j in range(m):
                duals[j] = first[j]
        known.values[slot], _ = improve_assignment(cost, clouds.k, duals, clouds.stop)
        known.lows[slot] = known.values[slot]
        _, known.levels[slot] = _dual_profile(cost, clouds.k, duals, known.profiles[slot])
    return slots.size


@jit
def estimate_vertices(clouds, known, slots):
    """Lower bounds on E and profiles at the vertices `slots` from the prices blended there.

    One pass over the costs instead of an assignment. `values` stays infinite: no upper bound is known.
    """
    cost = np.empty((clouds.source.shape[1], clouds.target.shape[1]))
    for at in range(slots.size):
        slot = slots[at]
        pair_costs(clouds, known.thetas[slot], cost)
        known.lows[slot], known.levels[slot] = _dual_profile(
            cost, clouds.k, known.duals[slot], known.profiles[slot]
        )
        known.values[slot] = np.inf


@jit
def _dual_profile(cost, k, b, profile):
    """Fill r_i = min_j (c_ij + b_j) - (sum b) / k; sum and greatest of its k smallest entries."""
    row_minima(cost, b, profile)
    share = total(b) / k
    for i in range(profile.size):
        profile[i] -= share
    mean = total(profile) / profile.size
    return smallest_sum(profile, k, mean, (mean - least(profile)) / profile.size)


@jit
def boxes_of(slots, which):
    """Boxes that have the vertex ``which[at]``: ``boxes[start[at] : start[at + 1]]``; `which` ascends."""
    first, n_boxes, n_vertices = which[0], slots.shape[0], slots.shape[1]
    place = np.empty(which[which.size - 1] - first + 1, np.int64)
    for at in range(place.size):
        place[at] = -1
    for at in range(which.size):
        place[which[at] - first] = at
    start, owner = np.zeros(which.size + 1, np.int64), np.empty(n_boxes * n_vertices, np.int64)
    found = 0
    for box in range(n_boxes):
        for v in range(n_vertices):
            slot = slots[box, v] - first
            if 0 <= slot < place.size and place[slot] >= 0:
                owner[found] = box * which.size + place[slot]
                start[place[slot] + 1] += 1
                found += 1
    for at in range(which.size):
        start[at + 1] += start[at]
    boxes, filled = np.empty(found, np.int64), np.zeros(which.size, np.int64)
    for entry in range(found):
        box, at = owner[entry] // which.size, owner[entry] % which.size
        boxes[start[at] + filled[at]] = box
        filled[at] += 1
    return start, boxes


@jit
def blend_prices(known, weights, slots, which, start, boxes, settled):
    """Prices at the vertices `which` from the other vertices of all boxes that have them (`boxes_of`).

    A mean with weights ``distance^-6``: optimal prices are continuous and piecewise linear in the costs,
    so the mean of the nearest on all sides lies closer than any one of them. Estimates count only where
    no neighbour is solved, and only those of slots below `settled`. Returns which vertices have any.
    """
    found, mean = np.empty(which.size, np.bool_), np.empty(known.duals.shape[1])
    for at in range(which.size):
        slot, whole = which[at], 0.0
        for j in range(mean.size):
            mean[j] = 0.0
        for place in range(start[at], start[at + 1]):
            for v in range(slots.shape[1]):
                other = slots[boxes[place], v]
                if other < 0 or other == slot:
                    continue
                solved = known.values[other] < np.inf
                if not solved and other >= settled:
                    continue
                distance = 0.0 if solved else _UNSOLVED
                for a in range(weights.size):
                    step = known.thetas[slot, a] - known.thetas[other, a]
                    distance += weights[a] * step**2
                weight = 1.0 / (distance * distance * distance)
                whole += weight
                for j in range(mean.size):
                    mean[j] += weight * known.duals[other, j]
        found[at] = whole > 0.0
        if found[at]:
            for j in range(mean.size):
                known.duals[slot, j] = mean[j] / whole
    return found
