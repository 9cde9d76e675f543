"""Vertices of a box of parameters."""

from __future__ import annotations

from dcreg.jit import jit_part


@jit_part
def n_vertices(lower, upper):
    """Return the number of distinct vertices of a box: axes of zero width do not count."""
    count = 1
    for a in range(lower.size):
        if upper[a] > lower[a]:
            count *= 2
    return count


@jit_part
def vertex(lower, upper, index, out):
    """Write the index-th distinct vertex of a box; bit a of the index refers to the a-th wide axis."""
    for a in range(lower.size):
        out[a] = lower[a]
        if upper[a] > lower[a]:
            if index & 1:
                out[a] = upper[a]
            index >>= 1
