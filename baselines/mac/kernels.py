"""Compiled enumeration of maximal cliques; see `baselines.mac.enumerate`."""

from __future__ import annotations

import numpy as np

from baselines._shared.kernels.graphs import (
    clear_bit,
    count_bits,
    count_bits_of,
    lowest_bit,
    set_bit,
)
from dcreg.jit import jit

NODES_PER_CLIQUE = 20  # of the search; a starting vertex stops beyond them


@jit
def cliques_from(rows, weights, first, before, max_cliques, cliques, heaviest):
    """List maximal cliques with `first` and without `before`; return their number, and whether all."""
    words = rows.shape[1]
    depth_limit = count_bits_of(rows[first]) + 2
    candidates = np.zeros((depth_limit, words), dtype=np.uint64)
    excluded = np.zeros((depth_limit, words), dtype=np.uint64)
    branches = np.zeros((depth_limit, words), dtype=np.uint64)
    path = np.empty(depth_limit, dtype=np.int64)
    sums = np.zeros(depth_limit)
    path[0] = first
    candidates[0] = rows[first] & ~before
    excluded[0] = rows[first] & before
    if not _branch(rows, candidates[0], excluded[0], branches[0]):
        return 0, True
    depth, count, nodes = 0, 0, NODES_PER_CLIQUE * max_cliques
    while depth >= 0:
        vertex = _take(branches[depth])
        if vertex < 0:
            depth -= 1
            continue
        inner = depth + 1
        candidates[inner] = candidates[depth] & rows[vertex]
        excluded[inner] = excluded[depth] & rows[vertex]
        clear_bit(candidates[depth], vertex)
        set_bit(excluded[depth], vertex)
        path[inner] = vertex
        sums[inner] = sums[depth]
        for k in range(inner):
            sums[inner] += weights[path[k], vertex]
        if _branch(rows, candidates[inner], excluded[inner], branches[inner]):
            depth = inner
        elif _is_empty(candidates[inner]) and _is_empty(excluded[inner]) and inner >= 2:
            count += 1
            _keep(path[: inner + 1], sums[inner], cliques, heaviest)
        nodes -= 1
        if count >= max_cliques or nodes == 0:
            return count, False
    return count, True


@jit
def _is_empty(row):
    return count_bits_of(row) == 0


@jit
def _take(row):
    """Remove and return the lowest set bit; -1 if none."""
    for w in range(len(row)):
        if row[w]:
            bit = lowest_bit(row[w])
            row[w] &= row[w] - np.uint64(1)
            return (w << 6) + bit
    return -1


@jit
def _branch(rows, candidates, excluded, branches):
    """Find the candidates that are not neighbours of the pivot; return False if there are none."""
    words = rows.shape[1]
    most, pivot = -1, -1
    for w in range(words):
        word = candidates[w] | excluded[w]
        while word:
            vertex = (w << 6) + lowest_bit(word)
            word &= word - np.uint64(1)
            known = 0
            for v in range(words):
                known += count_bits(candidates[v] & rows[vertex, v])
            if known > most:
                most, pivot = known, vertex
    any_left = False
    for w in range(words):
        branches[w] = candidates[w] & ~rows[pivot, w] if pivot >= 0 else candidates[w]
        any_left = any_left or branches[w] != 0
    return any_left


@jit
def _keep(path, weight, cliques, heaviest):
    for vertex in path:
        if weight > heaviest[vertex]:
            heaviest[vertex] = weight
            cliques[vertex, :] = np.uint64(0)
            for member in path:
                set_bit(cliques[vertex], member)
