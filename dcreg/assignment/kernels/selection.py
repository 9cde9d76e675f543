"""The minimum of some numbers, the k-th smallest, and the sum of the k smallest."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit, jit_inner, jit_part, jit_reduction

_MAGNITUDE = np.int64(0x7FFFFFFFFFFFFFFF)


@jit_part
def _ordered(bits):
    """Map the bits of a float64 to an integer of the same order; the map is its own inverse."""
    return bits ^ ((bits >> 63) & _MAGNITUDE)


@jit_inner
def least(values):
    """Minimum of a contiguous array without NaN.

    It compares integers, because the compiler vectorises their minimum but not that of floats.
    """
    low, bits = _MAGNITUDE, values.view(np.int64)
    for i in range(bits.size):
        low = min(low, _ordered(bits[i]))
    return np.int64(_ordered(low)).view(np.float64)


@jit_part
def cleared(values):
    """Return an array after it is filled with zeros; `np.zeros` takes longer to compile."""
    for at in np.ndindex(values.shape):
        values[at] = 0
    return values


@jit_inner
def place_of_least(values):
    """Return the index of the first minimum."""
    at = 0
    for i in range(1, values.size):
        if values[i] < values[at]:
            at = i
    return at


@jit_part
def kth_smallest(values, k):
    """Return the number with k others before it in ascending order (Hoare's selection, on a copy)."""
    work = np.empty(values.size)
    for i in range(values.size):
        work[i] = values[i]
    low, high = 0, work.size - 1
    while low < high:
        pivot = work[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while work[i] < pivot:
                i += 1
            while pivot < work[j]:
                j -= 1
            if i <= j:
                work[i], work[j] = work[j], work[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return work[k]


@jit
def sum_of_smallest(values, k):
    """Return the sum of the k smallest numbers, by selection."""
    if k == values.size:
        found = 0.0
        for i in range(values.size):
            found += values[i]
        return found
    level, count, found = kth_smallest(values, k - 1), 0, 0.0
    for i in range(values.size):
        if values[i] < level:
            found += values[i]
            count += 1
    return found + (k - count) * level


@jit_reduction
def _below(values, level):
    """Return how many numbers lie below `level`, and the sum of their distances from it."""
    count, depth = 0.0, 0.0
    for i in range(values.size):
        depth += max(level - values[i], 0.0)
    for i in range(values.size):
        count += 1.0 if values[i] < level else 0.0
    return count, depth


@jit_reduction
def total(values):
    """Return the sum, in the fastest order (the same in every run)."""
    found = 0.0
    for i in range(values.size):
        found += values[i]
    return found


@jit_inner
def smallest_sum(values, k, level, spacing):
    """Return the sum of the k smallest numbers, from below, and the largest of them, up to rounding.

    The sum is the maximum over t of the concave ``k t - sum max(0, t - value)``. Cutting planes find it
    in a few vectorised passes, while a selection would branch on every number. The number of passes is
    small if `level` is near the k-th smallest number and `spacing` near the spacing of the numbers
    around it.
    """
    if k == values.size:
        return total(values), level
    low = high = f_low = f_high = slope_low = slope_high = 0.0
    above = below = False  # whether points on both sides of the maximum are known
    best, at = -np.inf, level
    spacing += 1e-15 * abs(level) + 1e-300
    for _ in range(400):
        count, depth = _below(values, at)
        f, slope = k * at - depth, k - count
        if f > best:
            best, level = f, at
        if slope == 0.0:
            break
        if slope > 0.0:
            low, f_low, slope_low, below = at, f, slope, True
        else:
            high, f_high, slope_high, above = at, f, slope, True
        if above and below:
            at = (f_high - f_low + slope_low * low - slope_high * high) / (slope_low - slope_high)
            ceiling = f_low + slope_low * (at - low)
            if ceiling - best <= 1e-12 * abs(ceiling) or not low < at < high:
                break
        else:
            at += 1.5 * slope * spacing
            spacing *= 4.0
    return best, level
