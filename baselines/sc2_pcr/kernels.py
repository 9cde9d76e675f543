"""Compiled counts of common neighbours; see `baselines.sc2_pcr.consensus`."""

from __future__ import annotations

import numpy as np

from baselines._shared.kernels.graphs import count_bits, has_bit
from dcreg.jit import jit


@jit
def common_neighbours(rows, i):
    """Count the shared neighbours of i and each of its neighbours; 0 for others."""
    n = len(rows)
    counts = np.zeros(n, dtype=np.int64)
    for j in range(n):
        if has_bit(rows[i], j):
            for w in range(rows.shape[1]):
                counts[j] += count_bits(rows[i, w] & rows[j, w])
    return counts


@jit
def submatrix(rows, members):
    """Return the adjacency among `members`, 1 on the diagonal."""
    k = len(members)
    matrix = np.eye(k)
    for a in range(k):
        for b in range(a):
            if has_bit(rows[members[a]], members[b]):
                matrix[a, b] = matrix[b, a] = 1.0
    return matrix
