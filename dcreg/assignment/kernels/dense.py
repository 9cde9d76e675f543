"""Exact k-cardinality assignment: the cheapest k pairs, at most one per row and one per column.

This is a balanced transportation problem: a *spare* column is matched to the n - k unmatched rows and a
*dummy* row to the m - k unmatched columns, both at no cost. Any ``b >= 0`` gives feasible dual
variables, so the solver can start from those of a similar problem. Each row first takes its cheapest
column unless another row has it. Shortest augmenting paths match the remaining rows. Good dual
variables leave a few paths instead of k. Costs may be negative.

Nodes of the transportation problem: rows 0..n-1 and the dummy row n; columns 0..m-1 and the spare
column m. ``row_of[j]`` and ``col_of[i]`` are -1 while unmatched. The duals are ``a`` for rows and
``-b`` for columns, with ``a_i - b_j <= c_ij``.
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.selection import cleared, kth_smallest, least
from dcreg.jit import NEVER, jit, jit_inner, jit_part, jit_reduction

DUAL_UNIT = 2.0**-14  # of dual variables stored in 16 bits, in squared radii of the target


def cheapest_pairs(cost, k, stop=NEVER):
    """Return value, column of every row (-1: unmatched) and optimal duals of the cheapest k pairs.

    For calls from Python; kernels call `k_assignment_duals`. Both run the same compiled functions.
    """
    duals = np.zeros(cost.shape[1])
    if k == duals.size:  # as `first_duals`
        lowest = cost.min(axis=0)
        duals = lowest.max() - lowest
    value, col_of = improve_assignment(cost, k, duals, stop)
    return value, col_of, duals


@jit_part
def k_assignment(cost, k, stop):
    """Return value and column of every row (-1: unmatched) of the cheapest k pairs."""
    duals = np.empty(cost.shape[1])
    first_duals(cost, k, duals)
    return improve_assignment(cost, k, duals, stop)


@jit_part
def k_assignment_duals(cost, k, stop):
    """Return value, column of every row (-1: unmatched) and optimal duals of the cheapest k pairs."""
    duals = np.empty(cost.shape[1])
    first_duals(cost, k, duals)
    value, col_of = improve_assignment(cost, k, duals, stop)
    return value, col_of, duals


@jit_inner
def first_duals(cost, k, b):
    """Initial dual variables: zeros, or the minima of the columns if all columns are matched."""
    n, m = cost.shape
    for j in range(m):
        b[j] = 0.0
    if k == m:
        for j in range(m):
            b[j] = -cost[0, j]
            for i in range(1, n):
                b[j] = max(b[j], -cost[i, j])
        _take_least_off(b)


@jit_part
def _take_least_off(b):
    low = least(b)
    for j in range(b.size):
        b[j] -= low


@jit
def improve_assignment(cost, k, b, stop):
    """Return value and column of every row of the cheapest k pairs, from dual variables `b`.

    Parameters
    ----------
    cost : (n, m) array
    k : int
        1 <= k <= min(n, m).
    b : (m,) array
        Non-negative dual variables, optimal on return. The sum of the k smallest ``min_j (c_ij + b_j)``
        minus the sum of b is a lower bound, which optimal ones attain.
    stop : (1,) uint8 array
        Checked before every path. Once it is set, the returned values are incomplete.
    """
    n, m = cost.shape
    a = np.empty(n + 1)
    row_of, col_of, free = np.empty(m, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    for j in range(m):
        row_of[j] = -1
    for i in range(n):
        col_of[i] = -1
    spare_dual = _leave_rows(cost, k, b, a, col_of)
    n_free = _take_cheapest(cost, a, b, col_of, row_of, free)
    _lower_duals(cost, spare_dual, a, b, col_of, row_of)
    left = _leave_columns(m - k, a, b, row_of)
    starts = np.empty(n_free + left, np.int64)
    for path in range(starts.size):
        starts[path] = free[path] if path < n_free else n
    _augment(cost, spare_dual, a, b, col_of, row_of, starts, stop)
    _take_least_off(b)
    value = 0.0
    for i in range(n):
        if col_of[i] == m:
            col_of[i] = -1
        else:
            value += cost[i, col_of[i]]
    return value, col_of


@jit_inner
def row_minima(cost, b, out):
    """out_i = min_j (c_ij + b_j)."""
    total = np.empty(b.size)
    for i in range(cost.shape[0]):
        for j in range(b.size):
            total[j] = cost[i, j] + b[j]
        out[i] = least(total)


@jit_part
def _leave_rows(cost, k, b, a, col_of):
    """Assign the n - k rows with the largest minima to the spare column; return its dual variable."""
    n, m = cost.shape
    row_minima(cost, b, a)
    if k == n:
        return np.inf
    spare = kth_smallest(a[:n], k)
    left = n - k
    for i in range(n):
        if a[i] > spare:
            col_of[i] = m
            left -= 1
    for i in range(n - 1, -1, -1):
        if left > 0 and a[i] == spare:
            col_of[i] = m
            left -= 1
    return spare


@jit_part
def _take_cheapest(cost, a, b, col_of, row_of, free):
    """Match each row with a cheapest column that no other row has; list the other rows in `free`."""
    n, m = cost.shape
    n_free = 0
    for i in range(n):
        if col_of[i] == m:
            continue
        for j in range(m):
            if cost[i, j] + b[j] <= a[i] and row_of[j] < 0:
                row_of[j] = i
                col_of[i] = j
                break
        else:
            free[n_free] = i
            n_free += 1
    return n_free


@jit_reduction
def _raise_to(lowest, costs, level):
    for j in range(costs.size):
        lowest[j] = max(lowest[j], level - costs[j])


@jit_part
def _lower_duals(cost, spare_dual, a, b, col_of, row_of):
    """Lower the duals of unmatched columns as far as the row duals allow: most of them to zero."""
    n, m = cost.shape
    lowest, low = np.empty(m), least(b)
    for j in range(m):
        lowest[j] = low
    for i in range(n):
        _raise_to(lowest, cost[i], spare_dual if col_of[i] == m else a[i])
    for j in range(m):
        if row_of[j] < 0:
            b[j] = min(b[j], lowest[j])


@jit_part
def _leave_columns(left, a, b, row_of):
    """Assign unmatched columns with the smallest dual to the dummy row; return how many it lacks."""
    dummy = a.size - 1
    a[dummy] = least(b)
    for j in range(b.size):
        if left > 0 and row_of[j] < 0 and b[j] == a[dummy]:
            row_of[j] = dummy
            left -= 1
    return left


@jit_reduction
def _relax(costs, b, shift, row, dist, pred):
    """Shorten distances through `row`. Closed columns have infinite b."""
    for j in range(costs.size):
        d = shift + (costs[j] + b[j])
        closer = d < dist[j]
        dist[j] = d if closer else dist[j]
        pred[j] = row if closer else pred[j]


@jit_part
def _relax_spare(spare_cost, spare_row, b, shift, dist, pred):
    """Shorten distances through all rows at the spare column at once."""
    for j in range(b.size):
        d = shift + (spare_cost[j] + b[j])
        if d < dist[j]:
            dist[j] = d
            pred[j] = spare_row[j]


@jit_part
def _augment(cost, spare_dual, a, b, col_of, row_of, starts, stop):
    """Augment from each unmatched row, and from the dummy row once per column that it lacks."""
    n, m = cost.shape
    dummy, spare = n, m
    dist, open_b, no_cost = np.empty(m), np.empty(m), cleared(np.empty(m))
    pred = np.empty(m + 1, np.int64)
    scanned, reached = np.empty(m + 1, np.int64), np.empty(m + 1)
    spare_cost, spare_row = np.empty(m), np.empty(m, np.int64)
    spare_known = False  # cheapest row at the spare column, per column
    for source in starts:
        if stop[0]:
            return
        for j in range(m):
            dist[j], open_b[j] = np.inf, b[j]
        spare_dist, spare_open = np.inf, True
        dummy_entry, dummy_dist = -1, 0.0 if source == dummy else np.inf
        n_scanned, reach, row = 0, 0.0, source
        while True:
            if row == dummy:
                _relax(no_cost, open_b, reach - a[dummy], dummy, dist, pred)
            elif row >= 0:
                _relax(cost[row], open_b, reach - a[row], row, dist, pred)
                if spare_open and reach - a[row] + spare_dual < spare_dist:
                    spare_dist = reach - a[row] + spare_dual
                    pred[spare] = row
            elif row == -2:  # the rows at the spare column
                _relax_spare(spare_cost, spare_row, open_b, reach - spare_dual, dist, pred)
            low = least(dist)
            if spare_dist < low:
                column, reach = spare, spare_dist
            else:
                column, reach = _first(dist, low), low
                if row_of[column] < 0:
                    break
            scanned[n_scanned], reached[n_scanned] = column, reach
            n_scanned += 1
            if column == spare:
                spare_dist, spare_open = np.inf, False
                if not spare_known:
                    spare_known = True
                    _cheapest_spare_rows(cost, col_of, spare_cost, spare_row)
                row = -2
                continue
            dist[column] = open_b[column] = np.inf
            row = row_of[column]
            if row == dummy:
                if dummy_dist < np.inf:
                    row = -1
                else:
                    dummy_entry, dummy_dist = column, reach
        # duals
        if source != dummy:
            a[source] += reach
        if dummy_dist < np.inf:
            a[dummy] += reach - dummy_dist
        for p in range(n_scanned):
            j = scanned[p]
            if j == spare:
                spare_dual += reach - reached[p]
            else:
                b[j] += reach - reached[p]
                if row_of[j] != dummy:
                    a[row_of[j]] += reach - reached[p]
        joined, gone = _flip(column, source, dummy_entry, pred, col_of, row_of)
        if gone >= 0:
            a[gone] = spare_dual
        if spare_known and joined != gone:
            _update_spare_rows(cost, joined, gone, col_of, spare_cost, spare_row)


@jit
def _first(dist, low):
    at = dist.size
    for j in range(dist.size):
        at = min(at, j if dist[j] == low else dist.size)
    return at


@jit_part
def _flip(column, source, dummy_entry, pred, col_of, row_of):
    """Match along the path that ends in `column`; return the rows that joined and left the spare."""
    spare, dummy = row_of.size, col_of.size
    joined, gone = -1, -1
    while True:
        row = pred[column]
        if row == dummy:
            row_of[column] = dummy
            column = dummy_entry
        else:
            previous = col_of[row]
            col_of[row] = column
            if column == spare:
                joined = row
            else:
                row_of[column] = row
            if previous == spare:
                gone = row
            column = previous
        if row == source:
            return joined, gone


@jit_part
def _cheapest_spare_rows(cost, col_of, spare_cost, spare_row):
    for j in range(cost.shape[1]):
        spare_cost[j], spare_row[j] = np.inf, -1
    for i in range(cost.shape[0]):
        if col_of[i] == cost.shape[1]:
            for j in range(cost.shape[1]):
                if cost[i, j] < spare_cost[j]:
                    spare_cost[j] = cost[i, j]
                    spare_row[j] = i


@jit_part
def _update_spare_rows(cost, joined, gone, col_of, spare_cost, spare_row):
    n, m = cost.shape
    for j in range(m):
        if joined >= 0 and cost[joined, j] < spare_cost[j]:
            spare_cost[j] = cost[joined, j]
            spare_row[j] = joined
        if gone >= 0 and spare_row[j] == gone:
            spare_cost[j] = np.inf
            for i in range(n):
                if col_of[i] == m and cost[i, j] < spare_cost[j]:
                    spare_cost[j] = cost[i, j]
                    spare_row[j] = i
