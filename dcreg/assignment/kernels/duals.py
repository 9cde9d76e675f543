"""Dual variables of a sparse assignment: they show whether excluded pairs could lower its cost."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit

_MAX_PASSES = 10_000


@jit
def assignment_duals(columns, costs, col_of, own, m):
    """Dual variables u of rows and v <= 0 of columns that prove an optimal matching.

    Row i may take columns[i] at costs[i] (ascending); `own` is its cost, for its pair or for staying
    unmatched. v is lowered, and u_i = own_i - v_col raised, until ``cost >= u_i + v_j`` for all
    candidates. An excluded pair with ``cost >= u_i + v_j`` cannot lower the cost of the matching;
    ``cost >= u_i`` is sufficient. The last value tells whether the duals converged, as they do for an
    optimal matching.
    """
    u, v = own.copy(), np.zeros(m)
    tolerance = 0.0
    for cost in own:
        tolerance = max(tolerance, 1e-12 * cost)
    for _ in range(_MAX_PASSES):
        converged = True
        for i in range(columns.shape[0]):
            if col_of[i] >= 0:
                u[i] = own[i] - v[col_of[i]]
            for c in range(columns.shape[1]):
                if costs[i, c] >= u[i]:
                    break
                if costs[i, c] - u[i] < v[columns[i, c]] - tolerance:
                    v[columns[i, c]] = costs[i, c] - u[i]
                    converged = False
        if converged:
            return u, v, True
    return u, v, False
