"""Compatibility of matches: a rigid motion preserves the distance of two points."""

from __future__ import annotations

import math

import numpy as np

from dcreg.families.matches.kernels.lists import agreement
from dcreg.jit import jit


@jit
def compatible_matches(matches, shortest):
    """Return (N, words) bits: whether the lengths of two matches differ by at most `reach`.

    Matches that share a point, or that are nearer than `shortest` and thus carry little information,
    are not compatible.
    """
    n = matches.source.shape[0]
    bits = np.zeros((n, (n + 63) >> 6), dtype=np.uint64)
    for i in range(n):
        for j in range(i):
            a, b = _lengths(matches, i, j)
            if abs(a - b) <= matches.reach and min(a, b) >= shortest and not _share(matches, i, j):
                bits[i, j >> 6] |= np.uint64(1) << np.uint64(j & 63)
                bits[j, i >> 6] |= np.uint64(1) << np.uint64(i & 63)
    return bits


@jit
def closest_allies(bits, count):
    """Return (N, count) compatible matches that share most compatible ones with each; -1: none."""
    n, words = bits.shape
    allies = np.full((n, count), -1, dtype=np.int64)
    others, shared = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for i in range(n):
        known = 0
        for j in range(n):
            if (bits[i, j >> 6] >> np.uint64(j & 63)) & np.uint64(1):
                total = 0
                for w in range(words):
                    total += _count(bits[i, w] & bits[j, w])
                others[known], shared[known] = j, total
                known += 1
        order = np.argsort(-shared[:known], kind="mergesort")
        for k in range(min(count, known)):
            allies[i, k] = others[order[k]]
    return allies


@jit
def caps(matches, out):
    """Return, for each match, a bound on the score of any pose with which it agrees.

    Two residuals below the reach c change a distance by at most their sum. A match whose distance to
    this one changes by g therefore has a residual of at least g - c.
    """
    n = matches.source.shape[0]
    by_row, by_column = np.zeros(matches.n_rows), np.zeros(matches.n_columns)
    for i in range(n):
        by_row.fill(0.0)
        by_column.fill(0.0)
        for j in range(n):
            if i != j and _share(matches, i, j):
                continue
            a, b = _lengths(matches, i, j)
            gain = agreement(max(0.0, abs(a - b) - matches.reach), matches.reach)
            row, column = matches.rows[j], matches.columns[j]
            by_row[row] = max(by_row[row], gain)
            by_column[column] = max(by_column[column], gain)
        out[i] = min(by_row.sum(), by_column.sum())


@jit
def _lengths(matches, i, j):
    """Return the distance of two matches in the source and in the target."""
    a, b = 0.0, 0.0
    for axis in range(3):
        a += (matches.source[i, axis] - matches.source[j, axis]) ** 2
        b += (matches.target[i, axis] - matches.target[j, axis]) ** 2
    return math.sqrt(a), math.sqrt(b)


@jit
def _share(matches, i, j):
    return matches.rows[i] == matches.rows[j] or matches.columns[i] == matches.columns[j]


@jit
def _count(word):
    """Return the number of bits set."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))
