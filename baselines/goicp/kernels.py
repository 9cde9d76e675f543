"""The inner search of Go-ICP, over translations, compiled.

One search serves a rotation cube with centre R0. With e_i(t) = d(R0 x_i + t, Y), gamma_i the
rotation's uncertainty radius of point i and gamma_t a translation cube's half-diagonal, and sums
over the k smallest terms:

    true value   sum e_i(t)^2                                 an upper bound on the optimum
    relaxed      sum max(e_i(t) - gamma_i, 0)^2               an upper bound on the relaxed minimum
    bound        sum max(e_i(t0) - gamma_i - gamma_t, 0)^2    a lower bound over both cubes

All three come from the same distances, so the search for the rotation's lower bound also finds
the poses for its upper bound and no second search is run.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from baselines.goicp.distance import distance

FINISHED, PAUSED, FULL = 0, 1, 2

# Places in the state that a paused search keeps.
SIZE, DISCARDED, RELAXED, TRUE, TRUE_X, TRUE_Y, TRUE_Z, EVALUATED = range(8)


@njit(cache=True)
def cube_values(points, gamma, gamma_t, t, n_kept, cells, cutoff, scratch, dropped):
    """(bound, relaxed, true) of a translation cube with centre `t`; see the module's text.

    Terms are added one by one and most cubes need few of them: once the sum reaches `cutoff` the
    answer is (that sum, inf, inf), a lower bound still. `dropped` holds the largest terms met so
    far, as many as are trimmed in the end, which the sum leaves out.
    """
    n = len(points)
    n_dropped = n - n_kept
    bound = relaxed = 0.0
    for i in range(n):
        scratch[i] = distance(points[i, 0] + t[0], points[i, 1] + t[1], points[i, 2] + t[2], cells)
        rest = max(scratch[i] - gamma[i], 0.0)
        if n_dropped > 0:
            rest = _exchange(dropped, min(i, n_dropped), n_dropped, rest)
        # gamma_t is the same for all, so the smallest terms are those of the smallest rests.
        bound += max(rest - gamma_t, 0.0) ** 2
        relaxed += rest**2
        if bound >= cutoff:
            return bound, np.inf, np.inf
    true = 0.0
    for i in range(n):
        rest = scratch[i]
        if n_dropped > 0:
            rest = _exchange(dropped, min(i, n_dropped), n_dropped, rest)
        true += rest**2
    return bound, relaxed, true


@njit(cache=True)
def _exchange(dropped, size, capacity, value):
    """Put `value` among the largest so far; return the one that it pushed out (0 while none)."""
    if size < capacity:  # a heap with its least element first
        child = size
        while child > 0 and dropped[(child - 1) // 2] > value:
            dropped[child] = dropped[(child - 1) // 2]
            child = (child - 1) // 2
        dropped[child] = value
        return 0.0
    least = dropped[0]
    if value <= least:
        return value
    parent = 0
    while 2 * parent + 1 < size:
        child = 2 * parent + 1
        if child + 1 < size and dropped[child + 1] < dropped[child]:
            child += 1
        if dropped[child] >= value:
            break
        dropped[parent] = dropped[child]
        parent = child
    dropped[parent] = value
    return least


@njit(cache=True)
def search_translations(points, gamma, n_kept, cells, cutoff, gap, heap, state, budget):
    """Best-first search until the relaxed minimum is known to `gap`, or to be at least `cutoff`.

    Rows of `heap`: lower bound, centre, half-width of a cube. The bound found is the least of the
    first row and DISCARDED. After `budget` cubes the search pauses and can be called again.
    """
    scratch = np.empty(len(points))
    dropped = np.empty(len(points))
    centre = np.empty(3)
    size = int(state[SIZE])
    code = FINISHED
    spent = 0
    while size > 0:
        least = heap[0, 0]
        if least >= cutoff or state[RELAXED] - least <= gap:
            break
        if spent >= budget:
            code = PAUSED
            break
        if size + 8 > len(heap):
            code = FULL
            break
        x, y, z, half = heap[0, 1], heap[0, 2], heap[0, 3], heap[0, 4] / 2
        size = _pop(heap, size)
        gamma_t = np.sqrt(3.0) * half
        for octant in range(8):
            centre[0] = x + half * (1 if octant & 1 else -1)
            centre[1] = y + half * (1 if octant & 2 else -1)
            centre[2] = z + half * (1 if octant & 4 else -1)
            bound, relaxed, true = cube_values(
                points, gamma, gamma_t, centre, n_kept, cells, cutoff, scratch, dropped
            )
            spent += 1
            bound = max(bound, least)
            state[RELAXED] = min(state[RELAXED], relaxed)
            if true < state[TRUE]:
                state[TRUE] = true
                state[TRUE_X : TRUE_Z + 1] = centre
            if bound >= cutoff:
                state[DISCARDED] = min(state[DISCARDED], bound)
            else:
                size = _push(heap, size, bound, centre, half)
    state[SIZE] = size
    state[EVALUATED] += spent
    return code


@njit(cache=True)
def _push(heap, size, bound, centre, half):
    child = size
    while child > 0 and heap[(child - 1) // 2, 0] > bound:
        heap[child] = heap[(child - 1) // 2]
        child = (child - 1) // 2
    heap[child, 0] = bound
    heap[child, 1:4] = centre
    heap[child, 4] = half
    return size + 1


@njit(cache=True)
def _pop(heap, size):
    """Remove the first row."""
    size -= 1
    last = heap[size].copy()
    parent = 0
    while 2 * parent + 1 < size:
        child = 2 * parent + 1
        if child + 1 < size and heap[child + 1, 0] < heap[child, 0]:
            child += 1
        if heap[child, 0] >= last[0]:
            break
        heap[parent] = heap[child]
        parent = child
    heap[parent] = last
    return size
