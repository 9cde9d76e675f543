"""Exact maximum clique of a graph held as rows of bits.

Branch and bound in the manner of Tomita and Seki (2003) and San Segundo et al. (2011): vertices in
degeneracy order, one subproblem per vertex among its later neighbours, greedy colouring as bound.
The kernels stop after a number of steps and go on from where they were, so that a caller can look
at the clock: numba has none.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numba import njit

# Greedy cliques before the exact search. Any number is right. It decides between cliques of the same
# size, of which registration problems have dozens, with poses degrees apart: so few that ties fall
# as in the recorded runs of the official TEASER++ (tests/golden/test_teaser_port.py).
STARTS = 5
STEPS = 4_000_000  # row operations between two looks at the clock: some 10 milliseconds


@dataclass(frozen=True)
class Clique:
    """The largest clique found, sorted, and the least proven bound on the size of any."""

    vertices: np.ndarray
    upper_bound: int

    @property
    def is_maximum(self) -> bool:
        return len(self.vertices) == self.upper_bound


def maximum_clique(rows: np.ndarray, deadline: float = np.inf) -> Clique:
    """A maximum clique, or at the deadline the largest found with a bound on the maximum.

    Of several maximum cliques it is the one grown first from a few innermost vertices (`STARTS`),
    or where those are not maximum, the first in the lexicographic order that the degeneracy order
    of the vertices induces, whatever the search met first (unless the deadline cuts that short).

    Parameters
    ----------
    rows : (n, words) uint64
        Symmetric adjacency, bit j of row i, as `pack` makes it.
    deadline : float
        In terms of `time.perf_counter`.
    """
    n = len(rows)
    if n == 0:
        return Clique(np.empty(0, dtype=np.int64), 0)
    order, core = degeneracy(rows)
    most = np.maximum.accumulate(core[order])
    grown = best = _greedy(rows, order[::-1].copy(), STARTS)
    for place in range(n - 1, -1, -1):
        vertex = order[place]
        if most[place] < len(best):  # no larger clique starts here or earlier in the order
            break
        if core[vertex] < len(best):
            continue
        larger, finished = _extended(rows, order, core, [vertex], place, len(best), n, deadline)
        if len(larger) > len(best):
            best = larger
        if not finished or time.perf_counter() > deadline:
            bound = min(int(most[place]) + 1, _n_colours(rows))
            return Clique(np.sort(best), max(len(best), bound))
    if len(best) > len(grown):
        best = _first(rows, order, core, best, deadline)
    return Clique(np.sort(best), len(best))


def warm_up() -> None:
    """Compile all of the search, on a graph that the greedy start does not settle."""
    upper = np.triu(np.random.default_rng(0).random((60, 60)) < 0.5, 1)
    rows = pack(upper | upper.T)
    maximum_clique(rows)
    _n_colours(rows)


def _first(
    rows: np.ndarray, order: np.ndarray, core: np.ndarray, clique: np.ndarray, deadline: float
) -> np.ndarray:
    """The first of the maximum cliques, given any one of them.

    Vertex after vertex: the earliest that some maximum clique has next is taken.
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
            other, finished = _extended(rows, order, core, path, position, size - 1, size, deadline)
            if not finished or time.perf_counter() > deadline:
                return clique
            if len(other) == size:
                clique, known = other, position
                break
        chosen.append(int(order[known]))
        start = known + 1
        candidates &= _members(rows[chosen[-1]], len(rows))
    return clique


def _extended(
    rows: np.ndarray,
    order: np.ndarray,
    core: np.ndarray,
    path: list[int],
    place: int,
    size: int,
    goal: int,
    deadline: float,
) -> tuple[np.ndarray, bool]:
    """A clique of more than `size` that goes on from `path` behind `place`, empty if there is none.

    The largest, or the first found of `goal` vertices; not so when the search is not finished.
    """
    later = _common_later(rows, order, core, np.array(path), place, size)
    if len(later) + len(path) <= size:
        return np.empty(0, dtype=np.int64), True
    if len(later) == 0:
        return np.array(path), True
    search = _Search(rows, later, size - len(path), goal - len(path))
    finished = search.run(deadline)
    if not search.state[2]:
        return np.empty(0, dtype=np.int64), finished
    return np.concatenate([path, later[search.best]]), finished


class _Search:
    """Cliques of more than `size` and up to `goal` vertices in the subgraph on `members`."""

    def __init__(self, rows: np.ndarray, members: np.ndarray, size: int, goal: int) -> None:
        local, self.order = _subgraph(rows, members)
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

    def run(self, deadline: float) -> bool:
        """True when the search is complete."""
        parts = (self.rows, self.candidates, self.queue, self.colours, self.left)
        while not _search(*parts, self.path, self.found, self.state, STEPS):
            if time.perf_counter() > deadline:
                return False
        return True


def _members(row: np.ndarray, n: int) -> np.ndarray:
    return np.unpackbits(row.view(np.uint8), bitorder="little")[:n].astype(bool)


@njit(cache=True)
def count_bits(word):
    """Set bits of a word, all in parallel."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True)
def count_bits_of(row):
    """Set bits of a row of words."""
    total = 0
    for word in row:
        total += count_bits(word)
    return total


@njit(cache=True)
def lowest_bit(word):
    """Place of the lowest set bit; 64 for none."""
    return count_bits((word & (~word + np.uint64(1))) - np.uint64(1))


@njit(cache=True)
def has_bit(row, place):
    return (row[place >> 6] >> np.uint64(place & 63)) & np.uint64(1) != 0


@njit(cache=True)
def set_bit(row, place):
    row[place >> 6] |= np.uint64(1) << np.uint64(place & 63)


@njit(cache=True)
def clear_bit(row, place):
    row[place >> 6] &= ~(np.uint64(1) << np.uint64(place & 63))


@njit(cache=True)
def degrees(rows):
    """Number of neighbours of every vertex."""
    result = np.zeros(len(rows), dtype=np.int64)
    for i in range(len(rows)):
        result[i] = count_bits_of(rows[i])
    return result


def pack(adjacency: np.ndarray) -> np.ndarray:
    """Rows of bits of a boolean matrix, without its diagonal."""
    n = len(adjacency)
    wide = np.zeros((n, 64 * max(1, -(-n // 64))), dtype=bool)
    wide[:, :n] = adjacency
    wide[np.arange(n), np.arange(n)] = False
    return np.packbits(wide, axis=1, bitorder="little").view(np.uint64)


@njit(cache=True)
def degeneracy(rows):
    """Vertices in the order in which the least degree is removed, and their core numbers."""
    n = len(rows)
    degree = degrees(rows)
    # Bucket queue: vertices sorted by degree, with the start of each degree's bucket.
    start = np.zeros(n + 1, dtype=np.int64)
    for i in range(n):
        start[degree[i] + 1] += 1
    for k in range(n):
        start[k + 1] += start[k]
    order = np.empty(n, dtype=np.int64)
    place = np.empty(n, dtype=np.int64)
    fill = start.copy()
    for i in range(n):
        place[i] = fill[degree[i]]
        order[place[i]] = i
        fill[degree[i]] += 1
    for done in range(n):
        vertex = order[done]
        for w in range(rows.shape[1]):
            word = rows[vertex, w]
            while word:
                other = (w << 6) + lowest_bit(word)
                word &= word - np.uint64(1)
                if degree[other] > degree[vertex]:
                    first = start[degree[other]]  # swap it to the front of its bucket, then
                    swapped = order[first]  # let the bucket begin one later
                    order[place[other]], place[swapped] = swapped, place[other]
                    order[first], place[other] = other, first
                    start[degree[other]] += 1
                    degree[other] -= 1
    return order, degree


@njit(cache=True)
def _greedy(rows, order, starts):
    """The largest of the cliques grown along `order` from its first vertices, `starts` in number.

    A vertex of the best clique so far is no start: it would mostly grow the same one again.
    """
    n, words = rows.shape
    best = np.empty(0, dtype=np.int64)
    in_best = np.zeros(n, dtype=np.bool_)
    clique = np.empty(n, dtype=np.int64)
    common = np.empty(words, dtype=np.uint64)
    for first in order:
        if in_best[first]:
            continue
        if starts == 0:
            break
        starts -= 1
        clique[0], size = first, 1
        common[:] = rows[first]
        for other in order:
            if has_bit(common, other):
                clique[size] = other
                size += 1
                common &= rows[other]
        if size > len(best):
            best = clique[:size].copy()
            in_best[:] = False
            in_best[best] = True
    return best


@njit(cache=True)
def _common_later(rows, order, core, path, place, size):
    """Common neighbours of `path` behind `place` that can be in a clique of more than `size`."""
    common = rows[path[0]].copy()
    for k in range(1, len(path)):
        common &= rows[path[k]]
    later = np.empty(len(order) - place, dtype=np.int64)
    count = 0
    for position in range(place + 1, len(order)):
        other = order[position]
        if core[other] >= size and has_bit(common, other):
            later[count] = other
            count += 1
    return later[:count].copy()


@njit(cache=True)
def _subgraph(rows, members):
    """Adjacency among `members`, most neighbours first, and the member at each place."""
    p = len(members)
    words = (p + 63) >> 6
    local = np.zeros((p, words), dtype=np.uint64)
    degree = np.zeros(p, dtype=np.int64)
    for a in range(p):
        for b in range(a):
            if has_bit(rows[members[a]], members[b]):
                degree[a] += 1
                degree[b] += 1
    order = np.argsort(-degree, kind="mergesort")
    for a in range(p):
        for b in range(a):
            if has_bit(rows[members[order[a]]], members[order[b]]):
                set_bit(local[a], b)
                set_bit(local[b], a)
    return local, order


def _full(p: int, words: int) -> np.ndarray:
    bits = np.zeros(64 * words, dtype=bool)
    bits[:p] = True
    return np.packbits(bits, bitorder="little").view(np.uint64)


@njit(cache=True)
def _colour(rows, candidates, needed, queue, colours):
    """Greedy colouring of the candidates; those with colours beyond `needed`, in colour order.

    A clique has at most one vertex of a colour. Vertices of the first `needed` colours alone can
    therefore not form a clique of more than `needed`, and need no branch.
    """
    words = rows.shape[1]
    left = candidates.copy()
    of_colour = np.empty(words, dtype=np.uint64)
    count, colour = 0, 0
    remaining = True
    while remaining:
        colour += 1
        of_colour[:] = left
        remaining = False
        for w in range(words):
            while of_colour[w]:
                bit = lowest_bit(of_colour[w])
                vertex = (w << 6) + bit
                clear_bit(left, vertex)
                clear_bit(of_colour, vertex)
                for v in range(w, words):
                    of_colour[v] &= ~rows[vertex, v]
                if colour > needed:
                    queue[count] = vertex
                    colours[count] = colour
                    count += 1
            remaining = remaining or left[w] != 0
    return count


def _n_colours(rows: np.ndarray) -> int:
    """Colours that the greedy colouring uses: no clique has more vertices."""
    n, words = rows.shape
    queue, colours = np.zeros((2, n), dtype=np.int64)
    count = _colour(rows, _full(n, words), 0, queue, colours)
    return int(colours[count - 1])


@njit(cache=True)
def _search(rows, candidates, queue, colours, left, path, found, state, steps):
    """Some `steps` row operations of the depth-first search; True when it is complete."""
    words = rows.shape[1]
    depth, size, best, goal = state[0], state[1], state[2], state[3]
    while depth >= 0 and steps > 0:
        if left[depth] < 0:
            steps -= (1 + count_bits_of(candidates[depth])) * words
            needed = max(0, size - depth)
            left[depth] = _colour(rows, candidates[depth], needed, queue[depth], colours[depth])
        left[depth] -= 1
        k = left[depth]
        if k < 0 or depth + colours[depth, k] <= size:
            left[depth] = -1
            depth -= 1
            continue
        vertex = queue[depth, k]
        path[depth] = vertex
        clear_bit(candidates[depth], vertex)
        empty = True
        for w in range(words):
            candidates[depth + 1, w] = candidates[depth, w] & rows[vertex, w]
            empty = empty and candidates[depth + 1, w] == 0
        if empty:
            if depth + 1 > size:
                size = best = depth + 1
                found[:best] = path[:best]
                if best >= goal:
                    depth = -1
        else:
            depth += 1
            left[depth] = -1
    state[0], state[1], state[2] = depth, size, best
    return depth < 0
