"""Compiled bounds and objective, each over a batch of boxes or parameters."""

from __future__ import annotations

import numpy as np

from dcreg.kernels.assignment import k_assignment
from dcreg.kernels.compiling import jit
from dcreg.kernels.features import (
    allocate,
    curvature,
    enclose,
    feature_dim,
    interval_costs,
    move,
    n_vertices,
    norm_columns,
    on_line,
    pair_costs,
    vertex,
)
from dcreg.kernels.line import line_matching, line_value
from dcreg.kernels.sorting import COLUMNS, sort_columns


@jit
def objective(kind, source, target, k, theta):
    """E(theta) and the column of every source row."""
    n, m = source.shape[0], target.shape[1]
    if on_line(kind, target):  # no cost matrix
        norms = np.empty((n, 1))
        move(kind, source, theta, norms)
        return match_on_line(norms[:, 0].copy(), target[0], k)
    moved, _, cost = allocate(kind, n, m)
    move(kind, source, theta, moved)
    pair_costs(moved, target, cost)
    return k_assignment(cost, k)


@jit
def match_on_line(a, b, k):
    """Value and column of every row of the cheapest k pairs with cost (a_i - b_j)^2."""
    by_a, by_b = np.argsort(a, kind="mergesort"), np.argsort(b, kind="mergesort")
    matched = line_matching(a[by_a], b[by_b], k)
    col_of = np.full(a.size, -1, np.int64)
    value = 0.0
    for i in range(a.size):
        if matched[i] >= 0:
            row, column = by_a[i], by_b[matched[i]]
            col_of[row] = column
            value += (a[row] - b[column]) ** 2
    return value, col_of


@jit
def paper_bound(kind, source, target, k, lower, upper, bounds, thetas, values):
    """DC bound as published: tangent at the box centre, one assignment at every vertex.

    Fills per box the bound, the minimising vertex and the objective of the matching found there (an
    upper bound on E at that vertex). Returns the number of assignments.
    """
    dim = lower.shape[1]
    moved, missed, cost = allocate(kind, source.shape[0], target.shape[1])
    theta, delta, axes = np.empty(dim), np.empty(dim), source.T.copy()
    n_assignments = 0
    for box in range(lower.shape[0]):
        bounds[box] = np.inf
        for index in range(n_vertices(lower[box], upper[box])):
            vertex(lower[box], upper[box], index, theta)
            for a in range(dim):
                delta[a] = theta[a] - 0.5 * (lower[box, a] + upper[box, a])
            move(kind, source, theta, moved)
            pair_costs(moved, target, cost)
            curvature(kind, axes, delta, missed)
            for i in range(cost.shape[0]):
                for j in range(cost.shape[1]):
                    cost[i, j] -= missed[i]
            value, col_of = k_assignment(cost, k)
            n_assignments += 1
            if value < bounds[box]:
                bounds[box] = value
                thetas[box] = theta
                for i in range(col_of.size):
                    if col_of[i] >= 0:
                        value += missed[i]
                values[box] = value
    return n_assignments


@jit
def edge_bound(kind, source, target, k, lower, upper, bounds):
    """Every pair at its own best place in the box: sum of k interval distances, never negative."""
    n, q = source.shape[0], feature_dim(kind)
    centre, radius = np.empty((n, q)), np.empty((n, q))
    cost = np.empty((n, target.shape[1]))
    for box in range(lower.shape[0]):
        enclose(kind, source, lower[box], upper[box], centre, radius)
        interval_costs(centre, radius, target, cost)
        bounds[box], _ = k_assignment(cost, k)
    return lower.shape[0]


@jit
def objectives(kind, source, target, k, thetas, values):
    """E at every row of `thetas`. Returns the number of assignments."""
    if on_line(kind, target):
        return _objectives_on_line(kind, source, target[0], k, thetas, values)
    moved, _, cost = allocate(kind, source.shape[0], target.shape[1])
    for row in range(thetas.shape[0]):
        move(kind, source, thetas[row], moved)
        pair_costs(moved, target, cost)
        values[row], _ = k_assignment(cost, k)
    return thetas.shape[0]


@jit
def _objectives_on_line(kind, source, target, k, thetas, values):
    """`objectives` from sorted norms, several rows at once: sorting is most of the work.

    Every value is the same to the last bit whichever rows share its table: slices for threads may
    cut `thetas` anywhere.
    """
    n, rows = source.shape[0], thetas.shape[0]
    ordered, norms = np.sort(target), np.empty(n)
    table, shifts = np.empty((n, COLUMNS)), np.empty((3, COLUMNS))
    together = rows - 1 if rows % COLUMNS == 1 else rows  # one row alone is not worth a table
    for first in range(0, together, COLUMNS):
        for column in range(COLUMNS):  # beyond the last row: that row again
            shifts[:, column] = thetas[min(first + column, rows - 1)]
        norm_columns(source, shifts, table)
        sort_columns(table)
        for column in range(min(COLUMNS, rows - first)):
            norms[:] = table[:, column]
            values[first + column] = line_value(norms, ordered, k)
    for row in range(together, rows):
        move(kind, source, thetas[row], norms.reshape(n, 1))
        values[row] = line_value(np.sort(norms), ordered, k)
    return rows
