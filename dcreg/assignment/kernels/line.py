"""Exact k-cardinality assignment on a line: cost ``(a_i - b_j)^2`` for sorted scalars.

Sort the points of both sides in one merged order. The matched points form balanced intervals, each
matched in sorted order. Closing a *gap* adds one pair: it takes two neighbouring unmatched points of
opposite sides and matches everything between them again in sorted order. Closing the cheapest gap k
times is optimal for each number of pairs up to k, because these are the shortest augmenting paths of
the general problem. The cost of a gap is never below that of the gap before.

If the sides alternate around a new gap, its cost follows from its parts. Otherwise it is summed over
the interval, which is two contiguous slices of `a` and `b`. The heap takes O((n + m + k) log(n + m))
operations and the sums take at most ``k min(n, m)`` multiply-adds, in practice far fewer.
"""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit


@jit
def line_assignment(a, b, k, values):
    """Write the optimal values for 1..k pairs into `values`; return the last. a and b are sorted."""
    return _close_gaps(a, b, k, values, np.empty(a.size + b.size, np.bool_))


@jit
def line_value(a, b, k):
    """Return the optimum for k pairs only: O(n) if all points match."""
    if k == a.size and k == b.size:
        return _sorted_cost(a, b)
    return line_assignment(a, b, k, np.empty(k))


@jit
def line_matching(a, b, k):
    """Return the column of every row (-1: unmatched) of an optimal matching, in sorted indices."""
    n, m = a.size, b.size
    if k == n and k == m:
        return np.arange(n)
    free = np.empty(n + m, np.bool_)
    _close_gaps(a, b, k, np.empty(k), free)
    # the selected points are always matched in sorted order
    rows, columns = np.empty(k, np.int64), np.empty(k, np.int64)
    i = j = n_rows = n_columns = 0
    for p in range(n + m):
        if j == m or (i < n and a[i] <= b[j]):
            if not free[p]:
                rows[n_rows] = i
                n_rows += 1
            i += 1
        else:
            if not free[p]:
                columns[n_columns] = j
                n_columns += 1
            j += 1
    col_of = np.full(n, -1, np.int64)
    for pair in range(k):
        col_of[rows[pair]] = columns[pair]
    return col_of


@jit
def _close_gaps(a, b, k, values, free):
    """Close the cheapest gap k times; `free` marks the points of the merged order that stay unmatched."""
    n, m = a.size, b.size
    total_points = n + m
    is_a = np.empty(total_points, np.bool_)
    index = np.empty(total_points, np.int64)  # index within its own side
    place = np.empty(total_points)
    i = j = 0
    for p in range(total_points):
        free[p] = True
        is_a[p] = j == m or (i < n and a[i] <= b[j])
        if is_a[p]:
            index[p], place[p] = i, a[i]
            i += 1
        else:
            index[p], place[p] = j, b[j]
            j += 1
    left, right = np.empty(total_points, np.int64), np.empty(total_points, np.int64)
    matched = np.zeros(total_points)  # cost of the matched interval between p and right[p]
    increase = np.empty(total_points)  # of the cost if the gap (p, right[p]) is closed
    # heap of gaps; a gap is stale if its left end was matched or has another neighbour now
    key = np.empty(total_points + k)
    gap = np.empty((total_points + k, 2), np.int64)
    size = np.int64(0)  # not the literal 0, for which the heap's functions would be compiled again
    for p in range(total_points):
        left[p], right[p] = p - 1, p + 1
        if p + 1 < total_points and is_a[p] != is_a[p + 1]:
            increase[p] = (place[p + 1] - place[p]) ** 2
            size = _push(key, gap, size, increase[p], p, p + 1)
    total = 0.0
    for step in range(k):
        lo, hi = gap[0]
        while not (free[lo] and right[lo] == hi):
            size = _drop_first(key, gap, size)
            lo, hi = gap[0]
        total += increase[lo]
        values[step] = total
        free[lo] = free[hi] = False
        before, after = left[lo], right[hi]
        if after < total_points:
            left[after] = before
        size = _drop_first(key, gap, size)
        if before < 0:
            continue
        right[before] = after
        cost = matched[before] + matched[lo] + increase[lo] + matched[hi]
        if after < total_points and is_a[before] != is_a[after]:
            if is_a[before] != is_a[lo]:
                # alternating sides: the gaps on both sides close and this one opens again
                increase[before] += increase[hi] - increase[lo]
            else:
                pairs = (after - before + 1) // 2
                i, j = index[before], index[after] + 1
                if is_a[before]:
                    whole = _sorted_cost(a[i : i + pairs], b[j - pairs : j])
                else:
                    whole = _sorted_cost(a[j - pairs : j], b[i : i + pairs])
                increase[before] = whole - cost
            size = _push(key, gap, size, increase[before], before, after)
        matched[before] = cost
    return total


@jit
def _sorted_cost(a, b):
    """Return the sum of ``(a_i - b_i)^2``, in four partial sums so that it vectorises."""
    pairs = a.size
    s0 = s1 = s2 = s3 = 0.0
    whole = pairs - pairs % 4
    for t in range(0, whole, 4):
        d0, d1, d2, d3 = a[t] - b[t], a[t + 1] - b[t + 1], a[t + 2] - b[t + 2], a[t + 3] - b[t + 3]
        s0 += d0 * d0
        s1 += d1 * d1
        s2 += d2 * d2
        s3 += d3 * d3
    for t in range(whole, pairs):
        s0 += (a[t] - b[t]) ** 2
    return (s0 + s1) + (s2 + s3)


@jit
def _push(key, gap, size, increase, lo, hi):
    child = size
    while child > 0 and increase < key[(child - 1) // 2]:
        parent = (child - 1) // 2
        key[child], gap[child, 0], gap[child, 1] = key[parent], gap[parent, 0], gap[parent, 1]
        child = parent
    key[child], gap[child, 0], gap[child, 1] = increase, lo, hi
    return size + 1


@jit
def _drop_first(key, gap, size):
    size -= 1
    increase, lo, hi = key[size], gap[size, 0], gap[size, 1]
    at = 0
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and key[child + 1] < key[child]:
            child += 1
        if increase <= key[child]:
            break
        key[at], gap[at, 0], gap[at, 1] = key[child], gap[child, 0], gap[child, 1]
        at = child
    key[at], gap[at, 0], gap[at, 1] = increase, lo, hi
    return size
