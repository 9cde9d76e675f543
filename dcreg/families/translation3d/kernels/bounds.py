"""The DC bound of boxes in norm space, from the values at their vertices.

All R_i are equal, |v - theta0|^2, so the value at a vertex is sufficient for every theta0.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.families.dc.kernels import best_linearisation, n_vertices
from dcreg.families.translation3d.kernels.curvature import norm_curvature
from dcreg.jit import jit


@jit
def centre_bounds(values, k, lower, upper, slots, bounds):
    """Compute the bound with theta0 at the box centre, equally far from all vertices. Returns 0."""
    for box in range(lower.shape[0]):
        loss, low = 0.0, np.inf
        for a in range(lower.shape[1]):
            loss += (0.5 * (upper[box, a] - lower[box, a])) ** 2
        for v in range(n_vertices(lower[box], upper[box])):
            low = min(low, values[slots[box, v]])
        bounds[box] = low - k * loss
    return 0


@jit
def tight_bounds(clouds, vertices, lower, upper, slots, cutoff, thorough, bounds):
    """Compute the bound at the best theta0, with k |.|^2 and then with the curvature of E in the box.

    The latter needs a `reach`: an upper limit of E at the minimiser of the box. It is slightly above
    the cutoff or, if `thorough`, the minimum value at a vertex of the box. The minimum of the bound and
    the reach is always a bound. `vertices` holds positions and values by slot. Returns 0.
    """
    thetas, values = vertices
    k, dim = clouds.k, lower.shape[1]
    corner, known = np.empty((8, dim)), np.empty(8)
    point, centre, weights, own = np.empty(dim), np.empty(dim), np.empty(dim), np.empty(dim)
    for a in range(dim):
        weights[a] = float(k)
    for box in range(lower.shape[0]):
        count = n_vertices(lower[box], upper[box])
        reach = np.inf
        for v in range(count):
            known[v] = values[slots[box, v]]
            reach = min(reach, known[v])
            for a in range(dim):
                corner[v, a] = thetas[slots[box, v], a]
        floor, enough = -np.inf, np.inf
        if not thorough:
            reach = enough = 1.05 * cutoff
            floor = cutoff
        bounds[box] = best_linearisation(
            corner[:count], known[:count], weights, floor, enough, point
        )
        if not bounds[box] < (reach if thorough else cutoff) < np.inf:
            continue
        square = 0.0
        for a in range(dim):
            square += 0.25 * (upper[box, a] - lower[box, a]) ** 2
            centre[a] = 0.5 * (lower[box, a] + upper[box, a])
        norm_curvature(clouds.source, k, centre, math.sqrt(square), math.sqrt(max(0.0, reach)), own)
        bound = best_linearisation(corner[:count], known[:count], own, floor, enough, point)
        bounds[box] = max(bounds[box], min(bound, reach))
    return 0
