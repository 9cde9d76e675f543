"""Compiled inner search of Go-ICP over translations, and nearest distances.

A rotation cube with centre R0 needs two searches. Let e_i(t) = d(R0 x_i + t, Y), gamma_i the uncertainty
radius of point i by the rotation, gamma_t the half-diagonal of a translation cube, and take sums over
the k smallest terms:

    true value   sum e_i(t)^2                                 an upper bound on the optimum
    relaxed      sum max(e_i(t) - gamma_i, 0)^2               an upper bound on the relaxed minimum
    bound        sum max(e_i(t0) - gamma_i - gamma_t, 0)^2    a lower bound over both cubes

The first one has gamma_i = 0 and finds the best translation for R0, and with it the upper bound. The
second one has the radii and finds the lower bound; poses that it meets count as well.
"""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit

BLOCK = 4  # cells per axis that share one preliminary list
FINISHED, PAUSED, FULL = 0, 1, 2

# Entries of the state of a paused search.
SIZE, DISCARDED, RELAXED, TRUE, TRUE_X, TRUE_Y, TRUE_Z, EVALUATED = range(8)


@jit
def cube_values(points, gamma, gamma_t, t, n_kept, cells, cutoff, scratch, dropped):
    """Return (bound, relaxed, true) of a translation cube with centre `t`; see the module.

    Terms are added one by one, and most cubes need few. Once the sum reaches `cutoff` the result is (this
    sum, inf, inf), still a lower bound. `dropped` contains the largest terms so far, as many as are
    trimmed, which the sum leaves out.
    """
    n = len(points)
    n_dropped = n - n_kept
    bound = relaxed = 0.0
    for i in range(n):
        scratch[i] = distance(points[i, 0] + t[0], points[i, 1] + t[1], points[i, 2] + t[2], cells)
        rest = max(scratch[i] - gamma[i], 0.0)
        if n_dropped > 0:
            rest = _exchange(dropped, min(i, n_dropped), n_dropped, rest)
        # gamma_t is equal for all points, so the smallest terms have the smallest remainders.
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


@jit
def _exchange(dropped, size, capacity, value):
    """Insert `value` into the largest so far; return the value that it displaces (0 if none)."""
    if size < capacity:  # a heap with its minimum first
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


@jit
def search_translations(points, gamma, n_kept, cells, cutoff, gap, heap, state, budget):
    """Best-first search until the relaxed minimum is known to `gap`, or to be at least `cutoff`.

    Rows of `heap`: lower bound, centre, half-width of a cube. The bound is the minimum of the first row's
    and DISCARDED. After `budget` cubes the search pauses and can be called again.
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


@jit
def _push(heap, size, bound, centre, half):
    child = size
    while child > 0 and heap[(child - 1) // 2, 0] > bound:
        heap[child] = heap[(child - 1) // 2]
        child = (child - 1) // 2
    heap[child, 0] = bound
    heap[child, 1:4] = centre
    heap[child, 4] = half
    return size + 1


@jit
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


@jit
def distance(x, y, z, cells):
    """Return the distance of a position to the nearest target point."""
    grid, starts, points, wide, wide_starts, wide_points, target, size = cells
    n = size[0]
    cell = _cell(x, y, z, grid, n)
    if cell >= 0:
        return _nearest(x, y, z, points, starts[cell], starts[cell + 1])
    cell = _cell(x, y, z, wide, n)
    if cell >= 0:
        return _nearest(x, y, z, wide_points, wide_starts[cell], wide_starts[cell + 1])
    return _nearest(x, y, z, target, 0, len(target))


@jit
def _cell(x, y, z, grid, n):
    i = np.floor((x - grid[0]) * grid[3])
    j = np.floor((y - grid[1]) * grid[3])
    k = np.floor((z - grid[2]) * grid[3])
    if i < 0 or j < 0 or k < 0 or i >= n or j >= n or k >= n:
        return -1
    return (int(i) * n + int(j)) * n + int(k)


@jit
def _nearest(x, y, z, points, start, stop):
    best = np.inf
    for p in range(start, stop):
        dx, dy, dz = x - points[p, 0], y - points[p, 1], z - points[p, 2]
        best = min(best, dx * dx + dy * dy + dz * dz)
    return np.sqrt(best)


@jit
def all_distances(points, cells):
    found = np.empty(len(points))
    for i in range(len(points)):
        found[i] = distance(points[i, 0], points[i, 1], points[i, 2], cells)
    return found


@jit
def build(target, origin, side, n):
    """Return the start of each cell's list (n^3 + 1) and the coordinates of the lists, in C order."""
    m = len(target)
    blocks = n // BLOCK
    everyone = np.arange(m)
    shared = np.empty(m, np.int64)
    listed = np.empty(m, np.int64)
    counts = np.zeros(n * n * n + 1, np.int64)
    points = np.empty((0, 3))
    for fill in range(2):
        if fill:
            points = np.empty((counts.sum(), 3))
            counts = np.cumsum(counts)
        for block in range(blocks**3):
            bi, bj, bk = block // blocks**2, block // blocks % blocks, block % blocks
            wide = BLOCK * side
            n_shared = _candidates(
                target, everyone, m, origin[0] + (bi + 0.5) * wide, origin[1] + (bj + 0.5) * wide,
                origin[2] + (bk + 0.5) * wide, wide, shared,
            )  # fmt: skip
            for inside in range(BLOCK**3):
                i = bi * BLOCK + inside // BLOCK**2
                j = bj * BLOCK + inside // BLOCK % BLOCK
                k = bk * BLOCK + inside % BLOCK
                n_listed = _candidates(
                    target, shared, n_shared, origin[0] + (i + 0.5) * side,
                    origin[1] + (j + 0.5) * side, origin[2] + (k + 0.5) * side, side, listed,
                )  # fmt: skip
                cell = (i * n + j) * n + k
                if fill:
                    for p in range(n_listed):
                        points[counts[cell] + p] = target[listed[p]]
                else:
                    counts[cell + 1] = n_listed
    return counts, points


@jit
def _candidates(target, among, n_among, x, y, z, side, found):
    """Select the listed points that can be nearest in the cell with this centre; return their number."""
    squared = np.empty(n_among)
    for a in range(n_among):
        p = among[a]
        dx, dy, dz = x - target[p, 0], y - target[p, 1], z - target[p, 2]
        squared[a] = dx * dx + dy * dy + dz * dz
    # The edge of a cell belongs to it up to rounding, hence the small excess.
    limit = (np.sqrt(squared.min()) + np.sqrt(3.0) * side) ** 2 * (1 + 1e-9)
    n_found = 0
    for a in range(n_among):
        if squared[a] <= limit:
            found[n_found] = among[a]
            n_found += 1
    return n_found
