"""Compiled comparisons of lengths between two sets of points; see `baselines._shared.consistency`."""

from __future__ import annotations

import numpy as np

from baselines._shared.kernels.graphs import set_bit
from dcreg.jit import jit


@jit
def consistency_graph(source, target, pairs, tolerance, scale):
    """Set bit j of row i if the lengths agree and no point is shared.

    Lengths agree if ``| |y_i - y_j| - scale |x_i - x_j| | <= tolerance``.
    """
    n, d = source.shape
    rows = np.zeros((n, (n + 63) >> 6), dtype=np.uint64)
    for i in range(n):
        for j in range(i):
            if pairs[i, 0] == pairs[j, 0] or pairs[i, 1] == pairs[j, 1]:
                continue
            a, b = 0.0, 0.0
            for k in range(d):
                a += (source[i, k] - source[j, k]) ** 2
                b += (target[i, k] - target[j, k]) ** 2
            if abs(np.sqrt(b) - scale * np.sqrt(a)) <= tolerance:
                set_bit(rows[i], j)
                set_bit(rows[j], i)
    return rows


@jit
def length_ratios(source, target, tolerance, low, high):
    """Return ratios ``|y_i - y_j| / |x_i - x_j|`` that can be a scale in [low, high], and their ranges.

    The range of a ratio is its maximum change by noise: tolerance / ``|x_i - x_j|``.
    """
    n, d = source.shape
    ratios = np.empty(n * (n - 1) // 2)
    ranges = np.empty(len(ratios))
    count = 0
    for i in range(n):
        for j in range(i):
            a, b = 0.0, 0.0
            for k in range(d):
                a += (source[i, k] - source[j, k]) ** 2
                b += (target[i, k] - target[j, k]) ** 2
            a = np.sqrt(a)
            if a > tolerance:  # shorter ones do not bound the scale
                ratio, reach = np.sqrt(b) / a, tolerance / a
                if ratio + reach >= low and ratio - reach <= high:
                    ratios[count], ranges[count] = ratio, reach
                    count += 1
    return ratios[:count], ranges[:count]


@jit
def sweep_ends(values, ranges, order):
    """Return the weighted mean with the minimum truncated cost along the sorted interval ends."""
    n = len(values)
    weight, first, second, voters = 0.0, 0.0, 0.0, 0
    best, least = 0.0, np.inf
    for k in order:
        entering = k < n
        i = k if entering else k - n
        w = 1.0 / (ranges[i] * ranges[i])
        if not entering:
            w = -w
        voters += 1 if entering else -1
        weight += w
        first += w * values[i]
        second += w * values[i] ** 2
        if voters > 0:
            mean = first / weight
            cost = second - first * mean + (n - voters)
            if cost < least:
                best, least = mean, cost
    return best
