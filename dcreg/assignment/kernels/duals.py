"""Dual variables of a sparse assignment: they tell whether pairs left out could help."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit

_MAX_PASSES = 10_000


@jit
def assignment_duals(columns, costs, col_of, own, m):
    """Dual variables u of rows and v <= 0 of columns that prove an optimal matching.

    Row i may take columns[i] at costs[i] (ascending); `own` is what it pays, for its pair or for staying
    unmatched. v is lowered, and u_i = own_i - v_col raised, until ``cost >= u_i + v_j`` for all
    candidates. A pair left out with ``cost >= u_i + v_j``, for which ``cost >= u_i`` is enough, cannot
    help either. The last value tells whether they settled, as they do for an optimal matching.
    """
    u, v = own.copy(), np.zeros(m)
    tolerance = 1e-12 * own.max()
    for _ in range(_MAX_PASSES):
        settled = True
        for i in range(columns.shape[0]):
            if col_of[i] >= 0:
                u[i] = own[i] - v[col_of[i]]
            for c in range(columns.shape[1]):
                if costs[i, c] >= u[i]:
                    break
                if costs[i, c] - u[i] < v[columns[i, c]] - tolerance:
                    v[columns[i, c]] = costs[i, c] - u[i]
                    settled = False
        if settled:
            return u, v, True
    return u, v, False
