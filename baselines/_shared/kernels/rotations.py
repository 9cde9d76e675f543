"""Compiled rotation search by match lists; see `baselines._shared.rotation_search`."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit

_MIN_HALF_WIDTH = 1e-6  # radians; a smaller cube is not divided and keeps its upper bound
FINISHED, PAUSED = 0, 1
STACKED, BEST, GIVEN_UP, CUBES = range(4)  # entries of the integer state of a search


@jit
def divide_cubes(
    source, target, pairs, cosines, cutoff, slack, stack, spans, lists, state, rotation, budget
):  # fmt: skip
    """Search depth first, the most promising child first; pause after `budget` pair tests."""
    children = np.empty((8, 5))
    sizes = np.empty(8, np.int64)
    centre_rotation = np.empty((3, 3))
    tests = 0
    while state[STACKED] > 0:
        top = state[STACKED] - 1
        start, size = spans[top]
        if tests > budget or start + 9 * size > len(lists) or state[STACKED] + 8 > len(stack):
            return PAUSED
        upper = int(stack[top, 4])
        state[STACKED] = top
        if upper <= max(cutoff, state[BEST] + slack) or stack[top, 3] < _MIN_HALF_WIDTH:
            state[GIVEN_UP] = max(state[GIVEN_UP], upper)
            continue
        half = stack[top, 3] / 2
        delta = min(np.sqrt(3.0) * half, np.pi)
        kept = np.empty((8, size), np.int32)
        for octant in range(8):
            child = children[octant]
            for axis in range(3):
                child[axis] = stack[top, axis] + half * (1 if octant >> axis & 1 else -1)
            child[3], child[4], sizes[octant] = half, -1, 0
            angle = np.sqrt(child[0] ** 2 + child[1] ** 2 + child[2] ** 2)
            if angle - np.sqrt(3.0) * half > np.pi:
                continue  # outside the ball of rotation vectors: other cubes contain its rotations
            _rotation_of(child[0], child[1], child[2], angle, centre_rotation)
            bar = max(cutoff, state[BEST] + slack)
            sizes[octant], possible, matched = _match(
                source, target, pairs, cosines, lists[start : start + size], centre_rotation,
                np.cos(delta), np.sin(delta), upper, bar, kept[octant],
            )  # fmt: skip
            tests += size
            state[CUBES] += 1
            if matched > state[BEST]:
                state[BEST] = matched
                rotation[:] = centre_rotation
            child[4] = possible
        for octant in np.argsort(children[:, 4]):  # the best on top
            possible = children[octant, 4]
            if possible <= max(cutoff, state[BEST] + slack):
                state[GIVEN_UP] = max(state[GIVEN_UP], int(possible))
                continue
            top = state[STACKED]
            stack[top] = children[octant]
            spans[top, 0], spans[top, 1] = start, sizes[octant]
            lists[start : start + sizes[octant]] = kept[octant, : sizes[octant]]
            start += sizes[octant]
            state[STACKED] = top + 1
    return FINISHED


@jit
def _match(
    source, target, pairs, cosines, listed, rotation, cos_delta, sin_delta, upper, bar, kept
):  # fmt: skip
    """Return (pairs kept, source points with a possible partner, points matched by `rotation`).

    Stops with a valid bound and matched = 0 once too few points have a partner to exceed `bar`. `upper`
    points have pairs in the list.
    """
    n_kept = possible = matched = failed = 0
    position, last = 0, len(listed)
    while position < last:
        i = pairs[listed[position], 0]
        x = (
            rotation[0, 0] * source[i, 0]
            + rotation[0, 1] * source[i, 1]
            + rotation[0, 2] * source[i, 2]
        )
        y = (
            rotation[1, 0] * source[i, 0]
            + rotation[1, 1] * source[i, 1]
            + rotation[1, 2] * source[i, 2]
        )
        z = (
            rotation[2, 0] * source[i, 0]
            + rotation[2, 1] * source[i, 1]
            + rotation[2, 2] * source[i, 2]
        )
        is_possible = is_matched = False
        while position < last and pairs[listed[position], 0] == i:
            p = listed[position]
            j = pairs[p, 1]
            cosine = x * target[j, 0] + y * target[j, 1] + z * target[j, 2]
            c, s = cosines[p, 0], cosines[p, 1]
            # Rounding must neither lose a possible pair nor add a false match.
            if c + cos_delta <= 0.0 or cosine >= c * cos_delta - s * sin_delta - 1e-12:
                kept[n_kept] = p
                n_kept += 1
                is_possible = True
                if cosine >= c:
                    is_matched = True
            position += 1
        possible += is_possible
        matched += is_matched
        failed += not is_possible
        if upper - failed <= bar:
            return 0, upper - failed, 0
    return n_kept, possible, matched


@jit
def _rotation_of(x, y, z, angle, rotation):
    """Write the rotation of the vector (x, y, z) of this length into `rotation` (Rodrigues' formula)."""
    if angle < 1e-12:
        rotation[:] = np.eye(3)
        return
    x, y, z = x / angle, y / angle, z / angle
    c, s = np.cos(angle), np.sin(angle)
    v = 1.0 - c
    rotation[0] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
    rotation[1] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
    rotation[2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v
