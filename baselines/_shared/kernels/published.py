"""The published bound of DC-Reg, with an assignment at each vertex."""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import first_duals, improve_assignment
from dcreg.families.dc.kernels import curvature, pair_costs
from dcreg.jit import jit


@jit
def linearised_values(clouds, vertices, centre, values):
    """Write ``min_P sum p_ij (E_ij(v) - R_i(v - centre))`` at each vertex v of a box into `values`.

    Successive vertices are joined by an edge of the box, so their assignments are similar. Each
    assignment starts from the dual variables of the previous one, which saves time and changes no value.
    """
    n, m = clouds.source.shape[1], clouds.target.shape[-1]
    missed, cost, duals = np.empty(n), np.empty((n, m)), np.empty(m)
    for at in range(vertices.shape[0]):
        if clouds.stop[0]:
            break
        pair_costs(clouds, vertices[at], cost)
        curvature(clouds.target, clouds, vertices[at] - centre, missed)
        for i in range(n):
            for j in range(m):
                cost[i, j] -= missed[i]
        if at == 0:
            first_duals(cost, clouds.k, duals)
        values[at], _ = improve_assignment(cost, clouds.k, duals, clouds.stop)
