"""Compiled bounds by intervals of angles; see `baselines.gore.removal`."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit

# Margins for the rounding of cosines and of the ends of intervals.
COSINE_MARGIN = 1e-14
ANGLE_MARGIN = 1e-7
NEXT, LEFT, MOST, BEST, CHANGED = range(5)  # entries of the integer state of the intervals


@jit
def directions(source, target, tolerance):
    """Compute unit vectors, and the maximum angle between R x_i and y_i within the tolerance."""
    n = len(source)
    x, y = np.zeros((n, 3)), np.zeros((n, 3))
    spread = np.empty(n)
    for i in range(n):
        a, b = np.sqrt((source[i] ** 2).sum()), np.sqrt((target[i] ** 2).sum())
        if a > 0:
            x[i] = source[i] / a
        if b > 0:
            y[i] = target[i] / b
        if a <= tolerance or b <= tolerance:
            spread[i] = np.pi  # near the origin any rotation is possible
        else:
            cosine = (a**2 + b**2 - tolerance**2) / (2 * a * b)
            spread[i] = np.arccos(min(1.0, max(-1.0, cosine - COSINE_MARGIN)))
    return x, y, spread


@jit
def drop_by_arcs(x, y, spread, linked, wanted, alive, rotation, state, budget):
    """Bound by intervals; pause after `budget` arcs and return whether all are done.

    ``linked[k, i]``: whether a set may contain both k and i.
    """
    n = len(x)
    starts, ends = np.empty(2 * n), np.empty(2 * n)
    while True:
        for k in range(state[NEXT], n):
            if budget <= 0:
                state[NEXT] = k
                return False
            if not alive[k]:
                continue
            reach = 1
            for i in range(n):
                reach += linked[k, i] and alive[i] and i != k
            if reach >= wanted and spread[k] >= np.pi / 2:  # no rotation is excluded
                state[MOST] = max(state[MOST], reach)
                continue
            budget -= reach
            if reach < wanted:
                alive[k] = False
                state[LEFT] -= 1
                state[CHANGED] = 1
                continue
            align = _rotation_between(x[k], y[k])
            always, count = 1, 0
            for i in range(n):
                if i == k or not alive[i] or not linked[k, i]:
                    continue
                centre, half = arc(align @ x[i], y[i], y[k], spread[i] + spread[k])
                if half >= np.pi:
                    always += 1
                elif half >= 0:
                    low = (centre - half) % (2 * np.pi)
                    high = low + 2 * half
                    starts[count], ends[count] = low, min(high, 2 * np.pi)
                    count += 1
                    if high > 2 * np.pi:
                        starts[count], ends[count] = 0.0, high - 2 * np.pi
                        count += 1
            stabbed, angle = _stab(np.sort(starts[:count]), np.sort(ends[:count]))
            reach = always + stabbed
            if reach > state[BEST]:
                state[BEST] = reach
                rotation[:] = _about(y[k], angle) @ align
            if reach < wanted:
                alive[k] = False
                state[LEFT] -= 1
                state[CHANGED] = 1
            else:
                state[MOST] = max(state[MOST], reach)
        if not state[CHANGED]:
            return True
        state[NEXT] = state[MOST] = state[CHANGED] = 0


@jit
def arc(x, y, axis, reach):
    """Return the angles about `axis` that move x within `reach` of y: centre and half width.

    Half width pi for all angles, -1 for none.
    """
    a, b = np.dot(x, axis), np.dot(y, axis)
    across = np.sqrt(max(0.0, 1 - a * a) * max(0.0, 1 - b * b))
    if reach >= np.pi:
        return 0.0, np.pi
    needed = np.cos(reach) - a * b - COSINE_MARGIN
    if needed > across:
        return 0.0, -1.0
    if needed <= -across or across < 1e-6:  # too close to the axis to distinguish angles
        return 0.0, np.pi
    centre = np.arctan2(np.dot(np.cross(x, y), axis), np.dot(x, y) - a * b)
    return centre, min(np.pi, np.arccos(needed / across) + ANGLE_MARGIN)


@jit
def _stab(starts, ends):
    """Return the maximum number of closed intervals with a common point, and such a point."""
    best, where, inside, e = 0, 0.0, 0, 0
    for s in range(len(starts)):
        while ends[e] < starts[s]:
            inside -= 1
            e += 1
        inside += 1
        if inside > best:
            best, where = inside, (starts[s] + ends[e]) / 2
    return best, where


@jit
def _about(axis, angle):
    """Return the rotation about a unit axis."""
    s, c = np.sin(angle), np.cos(angle)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + s * cross + (1 - c) * (cross @ cross)


@jit
def _rotation_between(x, y):
    """Return the smallest rotation from unit vector x to unit vector y."""
    cosine = np.dot(x, y)
    if cosine < -1 + 1e-12:  # half a turn about any axis perpendicular to x
        least = np.argmin(np.abs(x))
        other = np.zeros(3)
        other[least] = 1.0
        axis = np.cross(x, other)
        return _about(axis / np.sqrt((axis**2).sum()), np.pi)
    v = np.cross(x, y)
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + cross + (cross @ cross) / (1 + cosine)
