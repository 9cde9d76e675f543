"""Bounds that solve their assignments box by box, and the objective at many parameters."""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.families.dc.kernels.boxes import n_vertices, vertex
from dcreg.families.dc.kernels.motion import curvature, interval_costs, pair_costs
from dcreg.families.kernels import add_penalty
from dcreg.jit import jit


@jit
def objectives(clouds, thetas, values):
    """Write E at every row of `thetas` into `values`; return the number of assignments."""
    cost = np.empty((clouds.source.shape[1], clouds.target.shape[-1]))
    for row in range(thetas.shape[0]):
        if clouds.stop[0]:
            break
        pair_costs(clouds, thetas[row], cost)
        values[row], _ = k_assignment(cost, clouds.k, clouds.stop)
    return thetas.shape[0]


@jit
def dc_bound(clouds, lower, upper, bounds, thetas, values):
    """Compute the published DC bound: tangent at the box centre, one assignment at every vertex.

    Fills, for each box, the bound, the minimising vertex and the objective of the matching found there,
    which is an upper bound on E at that vertex. Returns the number of assignments.
    """
    n, m, dim = clouds.source.shape[1], clouds.target.shape[-1], lower.shape[1]
    missed, cost = np.empty(n), np.empty((n, m))
    theta, delta = np.empty(dim), np.empty(dim)
    n_assignments = 0
    for box in range(lower.shape[0]):
        bounds[box] = np.inf
        for index in range(n_vertices(lower[box], upper[box])):
            if clouds.stop[0]:
                break
            vertex(lower[box], upper[box], index, theta)
            for a in range(dim):
                delta[a] = theta[a] - 0.5 * (lower[box, a] + upper[box, a])
            pair_costs(clouds, theta, cost)
            curvature(clouds.target, clouds.source, delta, missed)
            for i in range(n):
                for j in range(m):
                    cost[i, j] -= missed[i]
            value, col_of = k_assignment(cost, clouds.k, clouds.stop)
            n_assignments += 1
            if value < bounds[box]:
                bounds[box] = value
                for a in range(dim):
                    thetas[box, a] = theta[a]
                for i in range(n):
                    if col_of[i] >= 0:
                        value += missed[i]
                values[box] = value
    return n_assignments


@jit
def interval_bound(clouds, lower, upper, bounds):
    """Bound each pair by its own best parameter in the box: k interval distances, never negative."""
    cost = np.empty((clouds.source.shape[1], clouds.target.shape[-1]))
    for box in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        interval_costs(clouds.source, clouds.target, lower[box], upper[box], cost)
        add_penalty(clouds.infeasibility_penalty, cost)
        bounds[box], _ = k_assignment(cost, clouds.k, clouds.stop)
    return lower.shape[0]
