"""Exact k-cardinality assignment over a few candidate columns per row.

k shortest augmenting paths from all free rows, as in `dcreg.kernels.assignment`, but each search looks
only at the rows and columns near its path: free rows wait in one heap by their cheapest arc, and are
looked at when they could matter. Suited to nearest neighbours of large clouds.

Potentials: a free row has 0, the sink `level`, column j ``level + local_j`` with ``local_j <= 0``, and 0
where j is free. Only columns met by a search change their `local`.
"""

from __future__ import annotations

import numpy as np

from dcreg.kernels.compiling import jit


@jit
def sparse_assignment(columns, costs, m, k):
    """Cheapest k pairs among pairs (i, columns[i, c]) of cost costs[i, c], ascending in c; costs >= 0.

    Returns the number of pairs matched (less than k where the candidates admit no more), their cost,
    the column of every row (-1: unmatched), and whether pairs outside the candidates, each at least
    as dear as its row's last one, could not have helped.
    """
    n = columns.shape[0]
    col_of, row_of = np.full(n, -1, np.int64), np.full(m, -1, np.int64)
    own = np.zeros(n)  # cost of the row's pair
    local = np.zeros(m)
    distance, pred = np.full(m, np.inf), np.full(m, -1, np.int64)
    touched = np.empty(m, np.int64)
    waiting = np.empty((n, 2))  # heap of free rows: lower bound on the cheapest arc, row
    for i in range(n):
        waiting[i, 0], waiting[i, 1] = costs[i, 0], i
    n_waiting = n
    for at in range(n // 2 - 1, -1, -1):
        _sift_down(waiting, n_waiting, at)
    reached = np.empty((1024, 2))  # heap of columns: distance, column
    looked_at = np.empty(n, np.int64)
    level = 0.0
    matched = 0
    while matched < k:
        n_touched = n_reached = n_looked = 0
        best_free, sink = np.inf, -1
        while True:
            nearest = min(reached[0, 0] if n_reached > 0 else np.inf, best_free)
            if n_waiting > 0 and waiting[0, 0] < nearest:
                i = np.int64(waiting[0, 1])
                bound = waiting[0, 0]
                n_waiting = _drop_first(waiting, n_waiting)
                if col_of[i] >= 0:
                    continue
                cheapest = np.inf
                for c in range(columns.shape[1]):
                    cheapest = min(cheapest, costs[i, c] - local[columns[i, c]])
                if cheapest > bound:  # columns have become dearer since
                    n_waiting = _push(waiting, n_waiting, cheapest, i)
                    continue
                looked_at[n_looked] = i
                n_looked += 1
                base = 0.0
            elif n_reached > 0 and reached[0, 0] < best_free:
                d, j = reached[0, 0], np.int64(reached[0, 1])
                n_reached = _drop_first(reached, n_reached)
                if d > distance[j]:
                    continue
                i = row_of[j]
                base = d + local[j] - own[i]
            else:
                break
            for c in range(columns.shape[1]):
                if base + costs[i, c] >= best_free:
                    break
                j = columns[i, c]
                d = base + costs[i, c] - local[j]
                if d < distance[j] and d < best_free:
                    if distance[j] == np.inf:
                        touched[n_touched] = j
                        n_touched += 1
                    distance[j], pred[j] = d, i
                    if row_of[j] < 0:
                        best_free, sink = d, j
                        continue
                    if n_reached == len(reached):
                        reached = np.concatenate((reached, np.empty_like(reached)))
                    n_reached = _push(reached, n_reached, d, j)
        if sink < 0:
            break
        level = best_free
        for at in range(n_touched):
            j = touched[at]
            local[j] += min(0.0, distance[j] - level)
            distance[j] = np.inf
        j = sink
        while j >= 0:
            i = pred[j]
            row_of[j] = i
            col_of[i], j = j, col_of[i]
            for c in range(columns.shape[1]):
                if columns[i, c] == col_of[i]:
                    own[i] = costs[i, c]
                    break
        matched += 1
        for at in range(n_looked):
            i = looked_at[at]
            if col_of[i] < 0:
                # a lower bound: no column of the row has become cheaper
                n_waiting = _push(waiting, n_waiting, costs[i, 0], i)
    exact = matched == k
    if columns.shape[1] < m:
        for i in range(n):
            last = costs[i, columns.shape[1] - 1]
            if col_of[i] < 0:
                exact &= last >= level
            else:
                exact &= last + local[col_of[i]] - own[i] >= 0.0
    return matched, own[col_of >= 0].sum(), col_of, exact


@jit
def _push(heap, size, key, item):
    child = size
    while child > 0 and key < heap[(child - 1) // 2, 0]:
        heap[child] = heap[(child - 1) // 2]
        child = (child - 1) // 2
    heap[child, 0], heap[child, 1] = key, item
    return size + 1


@jit
def _drop_first(heap, size):
    size -= 1
    heap[0] = heap[size]
    _sift_down(heap, size, 0)
    return size


@jit
def _sift_down(heap, size, at):
    key, item = heap[at, 0], heap[at, 1]
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and heap[child + 1, 0] < heap[child, 0]:
            child += 1
        if key <= heap[child, 0]:
            break
        heap[at] = heap[child]
        at = child
    heap[at, 0], heap[at, 1] = key, item
