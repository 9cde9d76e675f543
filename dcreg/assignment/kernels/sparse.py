"""Assignments over few candidate pairs per row, in which an unmatched row costs a penalty."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit


@jit
def penalised_matching(columns, costs, penalty, stop, col_of, row_of, u, v):
    """Continue a matching to the cheapest one, if each unmatched row costs `penalty`.

    Finds shortest augmenting paths, unmatched row by unmatched row. A path may end at an unmatched
    column, or leave one of its rows unmatched. It therefore ends near its start, and the heap stays
    small. The cheapest matching for a smaller penalty remains the cheapest of its size, so only the rows
    that it leaves unmatched are searched again.

    Parameters
    ----------
    columns, costs : (n, c) arrays
        Candidates of every row, cheapest first; no cost is negative.
    penalty : float
    stop : (1,) uint8 array
        Checked before every row. Once it is set, the matching is incomplete.
    col_of, row_of, u, v : (n,), (m,) int arrays, (n,), (m,) arrays
        Column of each row and row of each column (-1: none), and the dual variables: those of the
        cheapest matching for a penalty of at most this one, or -1 and 0. Updated.
    """
    n, width = columns.shape
    m = row_of.size
    settled = np.empty(n, np.int64)
    dist, pred, done = np.full(m, np.inf), np.empty(m, np.int64), np.zeros(m, np.bool_)
    touched = np.empty(m, np.int64)
    keys, items = np.empty(4 * m + width), np.empty(4 * m + width, np.int64)
    for start in range(n):  # `np.flatnonzero` and the like would load much of Numba with the kernel
        if col_of[start] >= 0:
            continue
        if stop[0]:
            return
        row, reach, size, n_touched, n_settled = start, 0.0, 0, 0, 0
        end, end_row, end_col = np.inf, start, -1
        while True:
            if reach + penalty - u[row] < end:
                end, end_row, end_col = reach + penalty - u[row], row, -1
            for c in range(width):
                if reach + costs[row, c] - u[row] >= end:
                    break  # dual variables of columns are never positive
                j = columns[row, c]
                d = reach + costs[row, c] - u[row] - v[j]
                if d < dist[j] and d < end and not done[j]:
                    if dist[j] == np.inf:
                        touched[n_touched] = j
                        n_touched += 1
                    dist[j], pred[j] = d, row
                    if row_of[j] < 0:
                        end, end_row, end_col = d, row, j
                    else:
                        if size == keys.size:
                            keys, items = _twice(keys), _twice(items)
                        size = _push(keys, items, size, d, j)
            column = -1
            while size > 0 and column < 0:
                key, j, size = _pop(keys, items, size)
                if not done[j] and key == dist[j]:
                    column = j
            if column < 0 or dist[column] >= end:
                break
            done[column] = True
            settled[n_settled] = column
            n_settled += 1
            row, reach = row_of[column], dist[column]
        u[start] += end
        for p in range(n_settled):
            j = settled[p]
            u[row_of[j]] += end - dist[j]
            v[j] -= end - dist[j]
        if end_col < 0 and end_row != start:
            end_col = col_of[end_row]
            col_of[end_row] = -1
        if end_col >= 0:
            _flip(end_col, start, pred, row_of, col_of)
        for p in range(n_touched):
            dist[touched[p]], done[touched[p]] = np.inf, False


@jit
def _flip(column, start, pred, row_of, col_of):
    """Match along the path from `start` that ends in `column`."""
    while True:
        row = pred[column]
        before = col_of[row]
        col_of[row], row_of[column] = column, row
        if row == start:
            break
        column = before


@jit
def _push(keys, items, size, key, item):
    at = size
    while at > 0 and keys[(at - 1) // 2] > key:
        keys[at], items[at] = keys[(at - 1) // 2], items[(at - 1) // 2]
        at = (at - 1) // 2
    keys[at], items[at] = key, item
    return size + 1


@jit
def _pop(keys, items, size):
    """Remove the smallest key; return it, its item, and the remaining size."""
    key, item = keys[0], items[0]
    size -= 1
    last, at = keys[size], 0
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= last:
            break
        keys[at], items[at] = keys[child], items[child]
        at = child
    keys[at], items[at] = last, items[size]
    return key, item, size


@jit
def _twice(values):
    wider = np.empty(2 * values.size, values.dtype)
    for at in range(values.size):
        wider[at] = values[at]
    return wider


@jit
def greedy_matching(rows, columns, n, m, k):
    """Return the column of every row (-1: none): up to k pairs whose points are both unmatched."""
    col_of, taken = np.full(n, -1), np.zeros(m, np.bool_)
    count = 0
    for p in range(rows.size):
        if count < k and col_of[rows[p]] < 0 and not taken[columns[p]]:
            col_of[rows[p]] = columns[p]
            taken[columns[p]] = True
            count += 1
    return col_of
