"""Exact maximum clique of a graph stored as rows of bits.

Branch and bound as in Tomita and Seki (2003) and San Segundo et al. (2011): vertices in degeneracy order,
one subproblem per vertex among its later neighbours, greedy colouring as bound. The kernels pause after
a number of steps and continue from there, so that the caller can check the time limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from baselines._shared.kernels.graphs import (
    colour_order,
    common_later,
    degeneracy,
    greedy_clique,
    grow_cliques,
    subgraph,
)
from dcreg.search import Budget

# Greedy cliques before the exact search. Their number does not affect the size of the result, but
# which of several maximum cliques is found, and the poses of these may differ by degrees. With this
# number the choice agrees with recorded runs of the official TEASER++
# (tests/golden/test_teaser_port.py).
STARTS = 5
STEPS = 4_000_000  # row operations between two checks of the budget, about 10 milliseconds


@dataclass(frozen=True)
class Clique:
    """The largest clique found, sorted, and the best proven bound on the size.

    ``is_cut``: more time could lead to another clique, possibly of the same size.
    """

    vertices: np.ndarray
    upper_bound: int
    is_cut: bool = False

    @property
    def is_maximum(self) -> bool:
        return len(self.vertices) == self.upper_bound


def maximum_clique(rows: np.ndarray, budget: Budget) -> Clique:
    """Return a maximum clique, or the largest one found within the budget and a bound on the maximum.

    Of several maximum cliques it is the one grown first from a few innermost vertices (`STARTS`). If
    these are not maximum, it is the first in the lexicographic order that the degeneracy order of the
    vertices induces, independent of the order of the search (unless the budget is over).

    Parameters
    ----------
    rows : (n, words) uint64
        Symmetric adjacency, bit j of row i, as `pack` makes it.
    budget : Budget
    """
    n = len(rows)
    if n == 0:
        return Clique(np.empty(0, dtype=np.int64), 0)
    order, core = degeneracy(rows)
    most = np.maximum.accumulate(core[order])
    grown = best = greedy_clique(rows, order[::-1].copy(), STARTS)
    for place in range(n - 1, -1, -1):
        vertex = order[place]
        if most[place] < len(best):  # no larger clique starts here or earlier in the order
            break
        if core[vertex] < len(best):
            continue
        larger, finished = _extended(rows, order, core, [vertex], place, len(best), n, budget)
        if len(larger) > len(best):
            best = larger
        if not finished or budget.is_over:
            bound = min(int(most[place]) + 1, _n_colours(rows))
            return Clique(np.sort(best), max(len(best), bound), is_cut=True)
    is_cut = False
    if len(best) > len(grown):
        best, is_cut = _first(rows, order, core, best, budget)
    return Clique(np.sort(best), len(best), is_cut)


def warm_up() -> None:
    """Compile the whole search, on a graph that the greedy start does not solve."""
    upper = np.triu(np.random.default_rng(0).random((60, 60)) < 0.5, 1)
    rows = pack(upper | upper.T)
    maximum_clique(rows, Budget())
    _n_colours(rows)


def _first(
    rows: np.ndarray, order: np.ndarray, core: np.ndarray, clique: np.ndarray, budget: Budget
) -> tuple[np.ndarray, bool]:
    """Return the first maximum clique, given any, and whether the budget cut the search.

    Each step takes the earliest vertex with which some maximum clique continues.
    """
    size = len(clique)
    place = np.argsort(order)
    chosen: list[int] = []
    candidates = np.ones(len(rows), dtype=bool)
    start = 0
    while len(chosen) < size:
        clique = clique[np.argsort(place[clique])]
        known = int(place[clique[len(chosen)]])
        for position in range(start, known):
            vertex = int(order[position])
            if not candidates[vertex] or core[vertex] < size - 1:
                continue
            path = [*chosen, vertex]
            other, finished = _extended(rows, order, core, path, position, size - 1, size, budget)
            if not finished or budget.is_over:
                return clique, True
            if len(other) == size:
                clique, known = other, position
                break
        chosen.append(int(order[known]))
        start = known + 1
        candidates &= _members(rows[chosen[-1]], len(rows))
    return clique, False


def _extended(
    rows: np.ndarray,
    order: np.ndarray,
    core: np.ndarray,
    path: list[int],
    place: int,
    size: int,
    goal: int,
    budget: Budget,
) -> tuple[np.ndarray, bool]:
    """Return a clique of more than `size` vertices that continues `path` behind `place`; empty if none.

    It is the largest, or the first one of `goal` vertices, unless the search is not finished.
    """
    later = common_later(rows, order, core, np.array(path), place, size)
    if len(later) + len(path) <= size:
        return np.empty(0, dtype=np.int64), True
    if len(later) == 0:
        return np.array(path), True
    search = _Search(rows, later, size - len(path), goal - len(path))
    finished = search.run(budget)
    if not search.state[2]:
        return np.empty(0, dtype=np.int64), finished
    return np.concatenate([path, later[search.best]]), finished


class _Search:
    """Search of cliques of more than `size` and up to `goal` vertices in the subgraph on `members`."""

    def __init__(self, rows: np.ndarray, members: np.ndarray, size: int, goal: int) -> None:
        local, self.order = subgraph(rows, members)
        p, words = local.shape
        self.rows = local
        self.candidates = np.zeros((p + 1, words), dtype=np.uint64)
        self.candidates[0] = _full(p, words)
        self.queue = np.zeros((p + 1, p), dtype=np.int64)  # vertices of a depth in colour order
        self.colours = np.zeros((p + 1, p), dtype=np.int64)
        self.left = np.full(p + 1, -1, dtype=np.int64)  # of the queue; -1: not yet coloured
        self.path = np.zeros(p + 1, dtype=np.int64)
        self.found = np.zeros(p + 1, dtype=np.int64)
        # Depth, size to beat, size found, size to stop at.
        self.state = np.array([0, size, 0, goal], dtype=np.int64)

    @property
    def best(self) -> np.ndarray:
        return self.order[self.found[: self.state[2]]]

    def run(self, budget: Budget) -> bool:
        """Continue the search; return whether it is complete."""
        parts = (self.rows, self.candidates, self.queue, self.colours, self.left)
        while not grow_cliques(*parts, self.path, self.found, self.state, STEPS):
            if budget.is_over:
                return False
        return True


def _members(row: np.ndarray, n: int) -> np.ndarray:
    return np.unpackbits(row.view(np.uint8), bitorder="little")[:n].astype(bool)


def pack(adjacency: np.ndarray) -> np.ndarray:
    """Return the rows of bits of a boolean matrix, without its diagonal."""
    n = len(adjacency)
    wide = np.zeros((n, 64 * max(1, -(-n // 64))), dtype=bool)
    wide[:, :n] = adjacency
    wide[np.arange(n), np.arange(n)] = False
    return np.packbits(wide, axis=1, bitorder="little").view(np.uint64)


def _full(p: int, words: int) -> np.ndarray:
    bits = np.zeros(64 * words, dtype=bool)
    bits[:p] = True
    return np.packbits(bits, bitorder="little").view(np.uint64)


def _n_colours(rows: np.ndarray) -> int:
    """Return the number of colours of a greedy colouring; no clique has more vertices."""
    n, words = rows.shape
    queue, colours = np.zeros((2, n), dtype=np.int64)
    count = colour_order(rows, _full(n, words), 0, queue, colours)
    return int(colours[count - 1])
