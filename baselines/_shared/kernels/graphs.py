"""Compiled parts of the clique search on graphs as rows of bits; see `baselines._shared.cliques`."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit


@jit
def count_bits(word):
    """Count the set bits of a word."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@jit
def count_bits_of(row):
    """Count the set bits of a row of words."""
    total = 0
    for word in row:
        total += count_bits(word)
    return total


@jit
def lowest_bit(word):
    """Return the place of the lowest set bit; 64 for none."""
    return count_bits((word & (~word + np.uint64(1))) - np.uint64(1))


@jit
def has_bit(row, place):
    return (row[place >> 6] >> np.uint64(place & 63)) & np.uint64(1) != 0


@jit
def set_bit(row, place):
    row[place >> 6] |= np.uint64(1) << np.uint64(place & 63)


@jit
def clear_bit(row, place):
    row[place >> 6] &= ~(np.uint64(1) << np.uint64(place & 63))


@jit
def degrees(rows):
    """Return the number of neighbours of every vertex."""
    result = np.zeros(len(rows), dtype=np.int64)
    for i in range(len(rows)):
        result[i] = count_bits_of(rows[i])
    return result


@jit
def degeneracy(rows):
    """Return the vertices in degeneracy order (minimum degree first), and their core numbers."""
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


@jit
def greedy_clique(rows, order, starts):
    """Return the largest of the cliques grown along `order` from its first `starts` vertices.

    Vertices of the best clique so far are skipped: they mostly lead to the same clique.
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


@jit
def common_later(rows, order, core, path, place, size):
    """Return the common neighbours of `path` behind `place` that a clique beyond `size` can contain."""
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


@jit
def subgraph(rows, members):
    """Return the adjacency among `members`, most neighbours first, and the member at each place."""
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


@jit
def colour_order(rows, candidates, needed, queue, colours):
    """Colour the candidates greedily; return those with colours beyond `needed`, in colour order.

    A clique has at most one vertex of a colour. Vertices of the first `needed` colours therefore form no
    clique of more than `needed` vertices, and need no branch.
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


@jit
def grow_cliques(rows, candidates, queue, colours, left, path, found, state, steps):
    """Run about `steps` row operations of the depth-first search; return whether it is complete."""
    words = rows.shape[1]
    depth, size, best, goal = state[0], state[1], state[2], state[3]
    while depth >= 0 and steps > 0:
        if left[depth] < 0:
            steps -= (1 + count_bits_of(candidates[depth])) * words
            needed = max(0, size - depth)
            left[depth] = colour_order(
                rows, candidates[depth], needed, queue[depth], colours[depth]
            )
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
