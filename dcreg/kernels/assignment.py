"""Exact k-cardinality assignment: the cheapest k pairs, one per row and one per column.

Two solvers behind one function. When every row (or every column) is matched, Jonker-Volgenant style
shortest augmenting paths per row; otherwise k shortest augmenting paths from a super source, which
needs neither padding nor a big constant. Costs may be negative. Both return column duals ``b >= 0``
for `dual_bound`.
"""

from __future__ import annotations

import numpy as np

from dcreg.kernels.compiling import jit


@jit
def k_assignment_duals(cost, k):
    """Value, column of every row (-1: unmatched) and duals ``b`` of the cheapest k pairs."""
    n, m = cost.shape
    col_of = np.full(n, -1, np.int64)
    b = np.zeros(m)
    if k == n and n <= m:
        row_dual = np.empty(n)
        col_dual = np.zeros(m)
        row_of = np.full(m, -1, np.int64)
        _assign_rows(cost, col_of, row_of, row_dual, col_dual)
        shift = col_dual.max()
        for j in range(m):
            b[j] = shift - col_dual[j] if n == m else -col_dual[j]
    elif k == m:
        # every column is matched: the same problem on the transpose
        row_dual = np.empty(m)
        col_dual = np.zeros(n)
        row_of = np.full(m, -1, np.int64)
        _assign_rows(cost.T.copy(), row_of, col_of, row_dual, col_dual)
        shift = row_dual.max()
        for j in range(m):
            b[j] = shift - row_dual[j]
    else:
        _augment_k(cost, k, col_of, b)
    value = 0.0
    for i in range(n):
        if col_of[i] >= 0:
            value += cost[i, col_of[i]]
    return value, col_of, b


@jit
def k_assignment(cost, k):
    """Value and column of every row (-1: unmatched) of the cheapest k pairs."""
    value, col_of, _ = k_assignment_duals(cost, k)
    return value, col_of


@jit
def _assign_rows(cost, col_of, row_of, row_dual, col_dual):
    """Match every row (n <= m). Duals: row_dual_i + col_dual_j <= cost_ij, tight on matches."""
    n, m = cost.shape
    if n == m:  # columns are all matched too, so their duals are free: column reduction
        for j in range(m):
            low = cost[0, j]
            for i in range(1, n):
                low = min(low, cost[i, j])
            col_dual[j] = low
    for i in range(n):
        low, at = np.inf, -1
        for j in range(m):
            reduced = cost[i, j] - col_dual[j]
            if reduced < low:
                low, at = reduced, j
        row_dual[i] = low
        if row_of[at] < 0:
            row_of[at] = i
            col_of[i] = at
    dist = np.empty(m)
    pred = np.empty(m, np.int64)
    todo = np.empty(m, np.int64)
    scanned = np.empty(m, np.int64)
    for start in range(n):
        if col_of[start] >= 0:
            continue
        # Dijkstra over columns from the free row; todo[:n_todo] holds the unscanned ones
        for j in range(m):
            dist[j] = np.inf
            todo[j] = j
        n_todo, n_scanned = m, 0
        i, sink, reach = start, -1, 0.0
        while sink < 0:
            low, at = np.inf, -1
            base = reach - row_dual[i]
            for p in range(n_todo):
                j = todo[p]
                d = base + cost[i, j] - col_dual[j]
                if d < dist[j]:
                    dist[j] = d
                    pred[j] = i
                else:
                    d = dist[j]
                # among ties prefer a free column: it ends the path
                if d < low or (d == low and row_of[j] < 0):
                    low, at = d, p
            j = todo[at]
            reach = low
            n_todo -= 1
            todo[at] = todo[n_todo]
            if row_of[j] < 0:
                sink = j
            else:
                scanned[n_scanned] = j
                n_scanned += 1
                i = row_of[j]
        row_dual[start] += reach
        for p in range(n_scanned):
            j = scanned[p]
            row_dual[row_of[j]] += reach - dist[j]
            col_dual[j] -= reach - dist[j]
        j = sink
        while True:
            i = pred[j]
            row_of[j] = i
            j, col_of[i] = col_of[i], j
            if i == start:
                break


@jit
def _augment_k(cost, k, col_of, b):
    """k shortest augmenting paths from all free rows to any free column (k < min(n, m))."""
    n, m = cost.shape
    row_of = np.full(m, -1, np.int64)
    pot_col = np.zeros(m)
    pot_row = np.zeros(n)
    pot_sink = 0.0
    # cheapest free row of every column: the first arc of an augmenting path
    free_cost = np.full(m, np.inf)
    free_row = np.full(m, -1, np.int64)
    for i in range(n):
        for j in range(m):
            if cost[i, j] < free_cost[j]:
                free_cost[j] = cost[i, j]
                free_row[j] = i
    dist = np.empty(m)
    pred = np.empty(m, np.int64)
    done = np.empty(m, np.bool_)
    for _ in range(k):
        low, at = np.inf, -1
        for j in range(m):
            d = free_cost[j] - pot_col[j]
            dist[j] = d
            pred[j] = free_row[j]
            done[j] = False
            if d < low:
                low, at = d, j
        sink, sink_dist = -1, np.inf
        while at >= 0 and low < sink_dist:
            j0, best = at, low
            done[j0] = True
            low, at = np.inf, -1
            if row_of[j0] < 0:
                d = best + pot_col[j0] - pot_sink
                if d < sink_dist:
                    sink_dist, sink = d, j0
                for j in range(m):
                    if not done[j] and dist[j] < low:
                        low, at = dist[j], j
            else:
                i = row_of[j0]
                base = best + pot_row[i]
                for j in range(m):
                    if not done[j]:
                        d = base + cost[i, j] - pot_col[j]
                        if d < dist[j]:
                            dist[j] = d
                            pred[j] = i
                        else:
                            d = dist[j]
                        if d < low:
                            low, at = d, j
        for j in range(m):
            pot_col[j] += min(dist[j], sink_dist)
        pot_sink += sink_dist
        j = sink
        while True:
            i = pred[j]
            previous = col_of[i]
            col_of[i] = j
            row_of[j] = i
            if previous < 0:
                newly_matched = i
                break
            j = previous
        for i in range(n):
            if col_of[i] >= 0:
                pot_row[i] = pot_col[col_of[i]] - cost[i, col_of[i]]
        for j in range(m):
            if free_row[j] == newly_matched:
                free_cost[j] = np.inf
                free_row[j] = -1
                for i in range(n):
                    if col_of[i] < 0 and cost[i, j] < free_cost[j]:
                        free_cost[j] = cost[i, j]
                        free_row[j] = i
    for j in range(m):
        b[j] = max(0.0, pot_sink - pot_col[j])


@jit
def dual_bound(cost, k, b):
    """Lower bound on the k-assignment from any ``b >= 0``: k smallest min_j(c_ij+b_j), minus sum b."""
    n, m = cost.shape
    r = np.empty(n)
    for i in range(n):
        low = np.inf
        for j in range(m):
            low = min(low, cost[i, j] + b[j])
        r[i] = low
    if k < n:
        r = np.partition(r, k - 1)[:k]
    return r.sum() - b.sum()
