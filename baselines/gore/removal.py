"""Guaranteed outlier removal: drops correspondences that can be in no largest consensus set.

A consensus set holds the correspondences i with ``|R x_i + t - y_i| <= bound`` for one pose. Every
number called `reach` is at least the size of the largest consensus set through a correspondence;
what reaches less than a consensus set already found goes. Intervals may be too wide, never too
narrow, so rounding gets a margin.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numba import njit

from baselines._consistency import consistency_graph
from baselines._ransac import count_within
from baselines._robust import refit, squared_residuals

# For rounding: lengths (relative), cosines, and angles at which intervals end.
MARGIN = 1e-9
COSINE_MARGIN = 1e-14
ANGLE_MARGIN = 1e-7


@dataclass
class Removal:
    """What is left, and the largest consensus set met on the way."""

    kept: np.ndarray  # indices, sorted
    reach: np.ndarray  # bounds on the consensus sets through each that are not below `consensus`
    pose: np.ndarray | None
    consensus: int  # of that pose
    finished: bool


def remove_outliers(
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    deadline: float = np.inf,
) -> Removal:
    """Drop correspondences as long as one can be dropped, or to the deadline.

    Each is tried as a common origin, which leaves a problem of rotation among the correspondences
    whose lengths agree with it, at twice the bound.
    """
    n = len(source)
    rows_as_pairs = np.column_stack([np.arange(n), np.arange(n)])  # a point may be in several
    rows = consistency_graph(source, target, rows_as_pairs, 2 * bound * (1 + MARGIN), 1.0)
    graph = np.unpackbits(rows.view(np.uint8), axis=1, bitorder="little")[:, :n].astype(bool)
    alive = np.ones(n, dtype=bool)
    reach = graph.sum(axis=1) + 1
    best, most, finished = None, 0, True
    agreeing = np.zeros(n, dtype=bool)  # with the best pose: they reach that many, so they stay
    changed = True
    while changed and finished:
        changed = False
        for k in np.argsort(-reach, kind="stable"):
            if not alive[k] or agreeing[k]:
                continue
            members = np.flatnonzero(graph[k] & alive)
            reach[k] = min(reach[k], len(members) + 1)
            if reach[k] >= most:
                count, rotation = _rotation_reach(
                    source[members] - source[k], target[members] - target[k], 2 * bound, most - 1
                )
                reach[k] = min(reach[k], count + 1)
                pose = np.eye(4)
                pose[:3, :3], pose[:3, 3] = rotation, target[k] - rotation @ source[k]
                if count_within(source, target, pose, bound) > 0.5 * most:
                    pose = refit(pose, source, target, bound)
                consensus = int(count_within(source, target, pose, bound))
                if consensus > most:
                    best, most = pose, consensus
                    agreeing = squared_residuals(pose, source, target) <= bound**2
            if reach[k] < most:
                alive[k] = False
                changed = True
            if time.perf_counter() > deadline:
                finished = False
                break
    return Removal(np.flatnonzero(alive), reach, best, most, finished)


@njit(cache=True)
def _rotation_reach(source, target, tolerance, wanted):
    """Bound on ``|{i: |R x_i - y_i| <= tolerance}|`` over all rotations, and the best R met.

    Correspondences that reach fewer than `wanted` are dropped until none is; the bound holds for
    all sets of `wanted` and more.
    """
    n = len(source)
    rotation = np.eye(3)
    lengths_x, lengths_y = np.empty(n), np.empty(n)
    x, y = np.zeros((n, 3)), np.zeros((n, 3))
    spread = np.empty(n)  # largest angle between R x_i and y_i that the tolerance allows
    for i in range(n):
        lengths_x[i] = np.sqrt((source[i] ** 2).sum())
        lengths_y[i] = np.sqrt((target[i] ** 2).sum())
        if lengths_x[i] <= tolerance or lengths_y[i] <= tolerance:
            spread[i] = np.pi  # near the origin every rotation may do
            if lengths_x[i] > 0:
                x[i] = source[i] / lengths_x[i]
            if lengths_y[i] > 0:
                y[i] = target[i] / lengths_y[i]
            continue
        x[i] = source[i] / lengths_x[i]
        y[i] = target[i] / lengths_y[i]
        cosine = (lengths_x[i] ** 2 + lengths_y[i] ** 2 - tolerance**2) / (
            2 * lengths_x[i] * lengths_y[i]
        )
        spread[i] = np.arccos(min(1.0, max(-1.0, cosine - COSINE_MARGIN)))
    alive = np.ones(n, dtype=np.bool_)
    left, best = n, 0
    starts, ends = np.empty(2 * n), np.empty(2 * n)
    changed = True
    while changed:
        changed, most = False, 0
        for k in range(n):
            if not alive[k]:
                continue
            if spread[k] >= np.pi / 2:  # tells nothing of the rotation
                most = max(most, left)
                continue
            align = _rotation_between(x[k], y[k])
            always, count = 1, 0
            for i in range(n):
                if i == k or not alive[i]:
                    continue
                centre, half = _arc(align @ x[i], y[i], y[k], spread[i] + spread[k])
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
            if always + stabbed > best:
                best = always + stabbed
                rotation = _about(y[k], angle) @ align
            if always + stabbed < wanted:
                alive[k] = False
                left -= 1
                changed = True
            else:
                most = max(most, always + stabbed)
    return min(left, most), rotation


@njit(cache=True)
def _arc(x, y, axis, reach):
    """Angles about `axis` by which x comes within `reach` of y: centre and half width.

    Half width pi for all angles, -1 for none.
    """
    a, b = np.dot(x, axis), np.dot(y, axis)
    across = np.sqrt(max(0.0, 1 - a * a) * max(0.0, 1 - b * b))
    if reach >= np.pi:
        return 0.0, np.pi
    needed = np.cos(reach) - a * b - COSINE_MARGIN
    if needed > across:
        return 0.0, -1.0
    if needed <= -across or across < 1e-6:  # too near the axis to tell one angle from another
        return 0.0, np.pi
    centre = np.arctan2(np.dot(np.cross(x, y), axis), np.dot(x, y) - a * b)
    return centre, min(np.pi, np.arccos(needed / across) + ANGLE_MARGIN)


@njit(cache=True)
def _stab(starts, ends):
    """Most closed intervals with a common point, given sorted ends, and the middle of one best."""
    best, where, inside, e = 0, 0.0, 0, 0
    for s in range(len(starts)):
        while ends[e] < starts[s]:
            inside -= 1
            e += 1
        inside += 1
        if inside > best:
            best, where = inside, (starts[s] + ends[e]) / 2
    return best, where


@njit(cache=True)
def _about(axis, angle):
    """Rotation about a unit axis."""
    s, c = np.sin(angle), np.cos(angle)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + s * cross + (1 - c) * (cross @ cross)


@njit(cache=True)
def _rotation_between(x, y):
    """The least rotation from unit vector x to unit vector y."""
    cosine = np.dot(x, y)
    if cosine < -1 + 1e-12:  # half a turn about any axis across x
        least = np.argmin(np.abs(x))
        other = np.zeros(3)
        other[least] = 1.0
        axis = np.cross(x, other)
        return _about(axis / np.sqrt((axis**2).sum()), np.pi)
    v = np.cross(x, y)
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + cross + (cross @ cross) / (1 + cosine)
