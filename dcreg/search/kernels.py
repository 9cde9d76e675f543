"""Kernels of the search: the binary heap of open boxes, and a test for overlapping boxes.

The order of the heap is: lowest bound first, then the larger box, then the older one. The heap holds the
slots of boxes. Bounds, sizes and serial numbers are in arrays indexed by slot.
"""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit

FAN = 8  # boxes of one level that a box of the next level of a hierarchy contains


@jit
def _before(a, b, bounds, sizes, serials):
    if bounds[a] != bounds[b]:
        return bounds[a] < bounds[b]
    if sizes[a] != sizes[b]:
        return sizes[a] > sizes[b]
    return serials[a] < serials[b]


@jit
def push(heap, length, slots, bounds, sizes, serials):
    """Add `slots` to the heap; return its new length."""
    for slot in slots:
        at = length
        length += 1
        while at > 0:
            parent = (at - 1) // 2
            if not _before(slot, heap[parent], bounds, sizes, serials):
                break
            heap[at] = heap[parent]
            at = parent
        heap[at] = slot
    return length


@jit
def pop(heap, length, cutoff, bounds, sizes, serials, slots):
    """Move the best boxes to `slots` until it is full or no bound is below `cutoff`; return how many."""
    count = 0
    while count < slots.size and length > 0 and bounds[heap[0]] < cutoff:
        slots[count] = heap[0]
        count += 1
        length -= 1
        last, at = heap[length], 0
        while True:
            child = 2 * at + 1
            if child >= length:
                break
            if child + 1 < length and _before(heap[child + 1], heap[child], bounds, sizes, serials):
                child += 1
            if not _before(heap[child], last, bounds, sizes, serials):
                break
            heap[at] = heap[child]
            at = child
        heap[at] = last
    return count


@jit
def meeting(lower, upper, of_lower, of_upper, starts, meets):
    """Store in `meets` which boxes overlap a box of a hierarchy.

    A common face is no overlap, unless one of the two boxes has zero width along this axis.

    Parameters
    ----------
    lower, upper : (B, d) arrays
    of_lower, of_upper : (N, d) arrays
        The hierarchy, level by level. Level 0 has the boxes; each box of the next level contains `FAN`
        consecutive ones.
    starts : (levels + 1,) int array
        Where the levels begin, and their end.
    meets : (B,) bool array
    """
    top = starts.size - 2
    nodes, levels = np.empty(FAN * starts.size, np.int64), np.empty(FAN * starts.size, np.int64)
    for b in range(len(lower)):
        size = 0
        for node in range(starts[top], starts[top + 1]):
            nodes[size], levels[size] = node, top
            size += 1
        while size > 0:
            size -= 1
            node, level = nodes[size], levels[size]
            if not _overlap(lower[b], upper[b], of_lower[node], of_upper[node], level > 0):
                continue
            if level == 0:
                meets[b] = True
                break
            first = starts[level - 1] + (node - starts[level]) * FAN
            for child in range(first, min(first + FAN, starts[level])):
                nodes[size], levels[size] = child, level - 1
                size += 1


@jit
def _overlap(lower, upper, of_lower, of_upper, is_closed):
    """Tell whether two boxes overlap; closed ones also do if they only have a common face."""
    for c in range(len(lower)):
        low, high = max(lower[c], of_lower[c]), min(upper[c], of_upper[c])
        if low > high:
            return False
        if low == high and not is_closed and lower[c] < upper[c] and of_lower[c] < of_upper[c]:
            return False
    return True
