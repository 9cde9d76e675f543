"""Vertex values in 2D, and profiles that bound the k-assignment under any row charges.

With duals b >= 0 let r_i = min_j (c_ij + b_j) - (sum b) / k, the *profile*. For any b and any charge
R_i on the rows, the sum of the k smallest r_i - R_i is at most the k-assignment of c_ij - R_i. With
optimal b the k smallest r_i add up to E(v).
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import first_duals, improve_assignment, row_minima
from dcreg.assignment.kernels.selection import least, smallest_sum, total
from dcreg.families.dc.kernels.motion import pair_costs
from dcreg.jit import jit, jit_part

# Added to the squared distance of a vertex that was not solved, so that any solved one has more weight.
_UNSOLVED = 1e6


@jit
def bound_vertices(clouds, known, solve, warm, slots):
    """Fill bounds on E and profiles at the vertices `slots`; return the number of vertices evaluated.

    With `solve`, E is computed with optimal duals; with `warm`, from the stored duals. Otherwise the
    stored duals give a lower bound in one pass over the costs. `values` then stays infinite, because no
    upper bound is known.
    """
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    cost = np.empty((n, m))
    for at in range(slots.size):
        if clouds.stop[0]:
            break
        slot = slots[at]
        duals, value = known.duals[slot], np.inf
        pair_costs(clouds, known.thetas[slot], cost)
        if solve:
            if not warm:
                first_duals(cost, clouds.k, duals)
            value, _ = improve_assignment(cost, clouds.k, duals, clouds.stop)
        low, known.levels[slot] = _dual_profile(cost, clouds.k, duals, known.profiles[slot])
        known.lows[slot], known.values[slot] = value if solve else low, value
    return slots.size


@jit_part
def _dual_profile(cost, k, b, profile):
    """Fill r_i = min_j (c_ij + b_j) - (sum b) / k; return sum and maximum of its k smallest entries."""
    row_minima(cost, b, profile)
    share = total(b) / k
    for i in range(profile.size):
        profile[i] -= share
    mean = total(profile) / profile.size
    return smallest_sum(profile, k, mean, (mean - least(profile)) / profile.size)


@jit
def blend_duals(known, weights, slots, which, start, boxes, settled):
    """Estimate dual variables at vertices from the other vertices of all their boxes (`boxes_of`).

    The estimate is a mean with weights ``distance^-6``. Optimal duals are continuous and piecewise
    linear in the costs, so the mean over the nearest vertices on all sides is better than any of them.
    Estimated neighbours count only if no neighbour is solved, and only in slots below `settled`.
    Returns which vertices have an estimate.
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
