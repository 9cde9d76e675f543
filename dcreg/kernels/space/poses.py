"""Rigid poses as seen from one of them, and what pairs cost at least over a box of poses around it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.kernels.assignment.selection import sum_of_smallest
from dcreg.kernels.compiling import jit
from dcreg.kernels.space.geometry import chord_matrix, column_norms, transform


class View(NamedTuple):
    """A problem as seen from the centre of a box, which becomes the pose (I, 0).

    Attributes
    ----------
    moved : (3, n) array
        R_c x.
    reach : (n,) array
        |x|.
    shifted : (3, m) array
        y - t_c.
    prices : (n, m) array, or (0, 0) where every pair is feasible
    k : int
    """

    moved: np.ndarray
    reach: np.ndarray
    shifted: np.ndarray
    prices: np.ndarray
    k: int
    stop: np.ndarray


@jit
def relative_corners(centre, lower, upper, out):
    """Gibbs vectors from the rotation `centre` to the corners of a quaternion box.

    Fills rows of `out` (8, 3), returns their number; 0 where a corner lies a half-turn away or more.
    """
    count = 0
    a, b, c, d = centre[0], -centre[1], -centre[2], -centre[3]  # the inverse of the centre
    for v in range(16):
        flat = False
        for axis in range(4):
            flat |= (v >> axis) & 1 == 1 and upper[axis] <= lower[axis]
        if flat:  # the same corner as another one
            continue
        w = upper[0] if v & 1 else lower[0]
        x = upper[1] if v & 2 else lower[1]
        y = upper[2] if v & 4 else lower[2]
        z = upper[3] if v & 8 else lower[3]
        real = w * a - x * b - y * c - z * d
        if real <= 0.0:
            return 0
        out[count, 0] = (w * b + x * a + y * d - z * c) / real
        out[count, 1] = (w * c - x * d + y * a + z * b) / real
        out[count, 2] = (w * d + x * c - y * b + z * a) / real
        count += 1
    return count


@jit
def look_from(clouds, theta, view):
    """Move the points of `view` to where they are seen from the pose `theta`."""
    transform(chord_matrix(theta, theta), clouds.source, view.moved)
    for c in range(3):
        for j in range(clouds.target.shape[1]):
            view.shifted[c, j] = clouds.target[c, j] - theta[4 + c]


@jit
def cap_costs(view, angle, out):
    """Least squared distance of every target to every source turned by at most `angle`: (m, n)."""
    moved, reach, shifted, prices = view.moved, view.reach, view.shifted, view.prices
    cosine, sine = math.cos(angle), math.sin(angle)
    for j in range(shifted.shape[1]):
        u, v, w = shifted[0, j], shifted[1, j], shifted[2, j]
        other = u * u + v * v + w * w
        length = math.sqrt(other)
        row = out[j]
        for i in range(moved.shape[1]):
            full = reach[i] * length
            dot = moved[0, i] * u + moved[1, i] * v + moved[2, i] * w
            turned = dot * cosine + math.sqrt(max(0.0, full * full - dot * dot)) * sine
            best = full if dot >= full * cosine else turned
            row[i] = reach[i] * reach[i] + other - 2.0 * best
    add_prices_by_target(prices, out)


@jit
def add_prices_by_target(prices, out):
    """Add what pairs cost beyond their residual to (m, n) costs."""
    for i in range(prices.shape[0]):
        for j in range(prices.shape[1]):
            out[j, i] += prices[i, j]


@jit
def nearest_bound(caps, slack, k):
    """Sum of the k smallest squares of (nearest cap distance - slack)."""
    low = np.empty(caps.shape[1])
    for i in range(low.size):
        low[i] = caps[0, i]
    for j in range(1, caps.shape[0]):
        row = caps[j]
        for i in range(low.size):
            low[i] = row[i] if row[i] < low[i] else low[i]
    for i in range(low.size):
        low[i] = max(0.0, math.sqrt(max(0.0, low[i])) - slack) ** 2
    return sum_of_smallest(low, k)


@jit
def pair_costs(view, angle, half, out):
    """(n, m) least squared residuals of the pairs over the box, each pair on its own.

    Two bounds compete: the cap widened by the half-diagonal of the translations, and the box of
    translations widened by the longest chord of the rotations.
    """
    moved, shifted, prices = view.moved, view.shifted, view.prices
    h0, h1, h2 = half[0], half[1], half[2]
    slack = math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
    chord = 2.0 * math.sin(0.5 * angle)
    cosine, sine = math.cos(angle), math.sin(angle)
    lengths = np.empty(shifted.shape[1])
    column_norms(shifted, lengths)
    us, vs, ws = shifted[0], shifted[1], shifted[2]
    for i in range(out.shape[0]):
        x, y, z, own = moved[0, i], moved[1, i], moved[2, i], view.reach[i]
        widen = chord * own
        row = out[i]
        for j in range(row.size):
            u, v, w, length = us[j], vs[j], ws[j], lengths[j]
            full = own * length
            dot = x * u + y * v + z * w
            turned = dot * cosine + math.sqrt(max(0.0, full * full - dot * dot)) * sine
            best = full if dot >= full * cosine else turned
            capped = math.sqrt(max(0.0, own * own + length * length - 2.0 * best)) - slack
            a = max(0.0, abs(x - u) - h0)
            b = max(0.0, abs(y - v) - h1)
            c = max(0.0, abs(z - w) - h2)
            boxed = math.sqrt(a * a + b * b + c * c) - widen
            short = max(0.0, max(capped, boxed))
            row[j] = short * short
    for i in range(prices.shape[0]):
        for j in range(prices.shape[1]):
            out[i, j] += prices[i, j]


@jit
def pose_costs(theta, clouds, out):
    """(n, m) squared residuals at a pose, and the prices."""
    source, target, prices = clouds.source, clouds.target, clouds.prices
    moved = np.empty(source.shape)
    transform(chord_matrix(theta, theta), source, moved)
    for i in range(out.shape[0]):
        a, b, c = moved[0, i], moved[1, i], moved[2, i]
        for j in range(out.shape[1]):
            x = a - (target[0, j] - theta[4])
            y = b - (target[1, j] - theta[5])
            z = c - (target[2, j] - theta[6])
            out[i, j] = x * x + y * y + z * z
    for i in range(prices.shape[0]):
        for j in range(prices.shape[1]):
            out[i, j] += prices[i, j]


@jit
def nearest_scores(thetas, clouds, scores):
    """Sum of the k smallest squared nearest distances at every pose: a cheap guess of E."""
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    view = View(
        np.empty((3, n)), np.empty(n), np.empty((3, m)), clouds.prices, clouds.k, clouds.stop
    )
    column_norms(clouds.source, view.reach)
    caps = np.empty((m, n))
    for at in range(thetas.shape[0]):
        if clouds.stop[0]:
            break
        look_from(clouds, thetas[at], view)
        cap_costs(view, 0.0, caps)
        scores[at] = nearest_bound(caps, 0.0, clouds.k)
