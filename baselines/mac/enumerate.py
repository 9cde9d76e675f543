"""Maximal cliques of a graph in rows of bits, and for every vertex the heaviest that holds it."""

from __future__ import annotations

import time

import numpy as np
from numba import njit

from baselines._shared.cliques import clear_bit, count_bits, count_bits_of, lowest_bit, set_bit

NODES_PER_CLIQUE = 20  # of the search, beyond which a start is given up


class HeaviestCliques:
    """The heaviest maximal clique of at least three vertices through every vertex.

    Bron-Kerbosch with Tomita's pivot, one subproblem per vertex among those later in `order`, each
    capped at `max_cliques` maximal cliques: dense graphs have more than can be listed.
    """

    def __init__(
        self, rows: np.ndarray, weights: np.ndarray, order: np.ndarray, max_cliques: int
    ) -> None:
        n, words = rows.shape
        self.rows, self.weights, self.order, self.max_cliques = rows, weights, order, max_cliques
        self.cliques = np.zeros((n, words), dtype=np.uint64)  # as bits, for every vertex
        self.heaviest = np.full(n, -np.inf)
        self.n_cliques = 0
        self.n_capped = 0  # starting vertices whose cliques were not all listed

    def run(self, deadline: float = np.inf) -> bool:
        """List the cliques; True when no start was left out for want of time."""
        before = np.zeros(self.rows.shape[1], dtype=np.uint64)
        for vertex in self.order:
            count, complete = _start(
                self.rows, self.weights, vertex, before, self.max_cliques, self.cliques,
                self.heaviest,
            )  # fmt: skip
            self.n_cliques += count
            self.n_capped += not complete
            set_bit(before, vertex)
            if time.perf_counter() > deadline:
                return False
        return True

    def distinct(self) -> list[np.ndarray]:
        """The kept cliques without repetition, the heaviest first."""
        kept = np.flatnonzero(np.isfinite(self.heaviest))
        kept = kept[np.argsort(-self.heaviest[kept], kind="stable")]
        seen: dict[bytes, np.ndarray] = {}
        for vertex in kept:
            row = self.cliques[vertex]
            bits = np.unpackbits(row.view(np.uint8), bitorder="little")
            seen.setdefault(row.tobytes(), np.flatnonzero(bits))
        return list(seen.values())


@njit(cache=True)
def _start(rows, weights, first, before, max_cliques, cliques, heaviest):
    """Maximal cliques with `first` and no vertex of `before`: their number, and whether all."""
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


@njit(cache=True)
def _is_empty(row):
    return count_bits_of(row) == 0


@njit(cache=True)
def _take(row):
    """Remove and return the lowest set bit, -1 for none."""
    for w in range(len(row)):
        if row[w]:
            bit = lowest_bit(row[w])
            row[w] &= row[w] - np.uint64(1)
            return (w << 6) + bit
    return -1


@njit(cache=True)
def _branch(rows, candidates, excluded, branches):
    """Candidates that the pivot does not know; False when there is nothing to branch on."""
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


@njit(cache=True)
def _keep(path, weight, cliques, heaviest):
    for vertex in path:
        if weight > heaviest[vertex]:
            heaviest[vertex] = weight
            cliques[vertex, :] = np.uint64(0)
            for member in path:
                set_bit(cliques[vertex], member)
