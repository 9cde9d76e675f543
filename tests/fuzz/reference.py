"""Optima of tiny problems without the library: every matching tried, each with its exact best pose.

Written from the problem statement alone and importing nothing of `dcreg`, so that a mistake there
cannot repeat itself here. A matching is grown row by row; what its best pose costs follows from sums
over its pairs in closed form: complex numbers in 2D, the largest eigenvalue of Horn's matrix in 3D. In
norm space a matching's best translation has no closed form. There a Lipschitz search over cubes
encloses the optimum: a residual vector moves no faster than the translation does, so

    sqrt(E(t)) >= sqrt(E(c)) - sqrt(k) |t - c|.
"""

from __future__ import annotations

import math

import numba
import numpy as np


def jit(function):
    return numba.njit(function, cache=True, error_model="numpy")


# --- 2D similarity and 3D rigid: all matchings --------------------------------------------------


@jit
def optimum(source, target, allowed, k, low, high):
    """Least sum of squared residuals over k-matchings of allowed pairs and poses of the dimension.

    These are similarities with a scale in a range in 2D, and proper rigid poses in 3D.
    """
    n, m = allowed.shape
    column = np.full(n, -2)  # of a row: -2 not yet tried, -1 left out
    used = np.zeros(m, np.bool_)
    count = np.zeros(n + 1, np.int64)
    best = np.inf
    row = 0
    while row >= 0:
        if count[row] == k:
            if source.shape[1] == 2:
                cost = _similarity_cost(source, target, column[:row], k, low, high)
            else:
                cost = _rigid_cost(source, target, column[:row], k)
            best = min(best, cost)
            row -= 1
            continue
        if row == n or not _advance(row, column, used, allowed, k - count[row]):
            row -= 1
            continue
        count[row + 1] = count[row] + (column[row] >= 0)
        row += 1
        if row < n:
            column[row] = -2
    return best


@jit
def _advance(row, column, used, allowed, missing):
    """Next choice of `row`: its columns in turn, then left out while enough rows remain."""
    n, m = allowed.shape
    if column[row] == -1:
        column[row] = -2
        return False
    first = 0
    if column[row] >= 0:
        used[column[row]] = False
        first = column[row] + 1
    for j in range(first, m):
        if allowed[row, j] and not used[j]:
            used[j] = True
            column[row] = j
            return True
    if n - row - 1 >= missing:
        column[row] = -1
        return True
    column[row] = -2
    return False


@jit
def _similarity_cost(source, target, column, k, low, high):
    sum_x, sum_y, sum_xy = 0j, 0j, 0j
    square_x, square_y = 0.0, 0.0
    for i in range(column.size):
        if column[i] >= 0:
            x = complex(source[i, 0], source[i, 1])
            y = complex(target[column[i], 0], target[column[i], 1])
            sum_x += x
            sum_y += y
            sum_xy += np.conj(x) * y
            square_x += abs(x) ** 2
            square_y += abs(y) ** 2
    a = square_x - abs(sum_x) ** 2 / k
    b = square_y - abs(sum_y) ** 2 / k
    c = abs(sum_xy - np.conj(sum_x) * sum_y / k)
    scale = high if c >= high * a else max(low, c / a)
    return max(0.0, scale * scale * a - 2.0 * scale * c + b)


@jit
def _rigid_cost(source, target, column, k):
    """Horn 1987: the best rotation's gain is the largest eigenvalue of a symmetric 4 x 4 matrix."""
    mean_x, mean_y = np.zeros(3), np.zeros(3)
    for i in range(column.size):
        if column[i] >= 0:
            mean_x += source[i] / k
            mean_y += target[column[i]] / k
    S = np.zeros((3, 3))
    spread = 0.0
    for i in range(column.size):
        if column[i] >= 0:
            x, y = source[i] - mean_x, target[column[i]] - mean_y
            for a in range(3):
                spread += x[a] ** 2 + y[a] ** 2
                for b in range(3):
                    S[a, b] += x[a] * y[b]
    horn = np.empty((4, 4))
    horn[0, 0] = S[0, 0] + S[1, 1] + S[2, 2]
    horn[0, 1] = S[1, 2] - S[2, 1]
    horn[0, 2] = S[2, 0] - S[0, 2]
    horn[0, 3] = S[0, 1] - S[1, 0]
    for a in range(3):
        for b in range(3):
            horn[a + 1, b + 1] = S[a, b] + S[b, a]
        horn[a + 1, a + 1] -= horn[0, 0]
        horn[a + 1, 0] = horn[0, a + 1]
    return max(0.0, spread - 2.0 * np.linalg.eigvalsh(horn)[3])


# --- the objective at a pose ---------------------------------------------------------------------


@jit
def cheapest_matching(cost, allowed, k):
    """Least sum of k allowed entries in different rows and columns: by subsets of columns."""
    n, m = cost.shape
    size = 1 << m
    best = np.full(size, np.inf)  # over the rows so far, by the set of columns they use
    best[0] = 0.0
    for i in range(n):
        for subset in range(size - 1, -1, -1):  # larger sets first: a row counts once
            for j in range(m):
                if subset >> j & 1 and allowed[i, j]:
                    best[subset] = min(best[subset], best[subset ^ (1 << j)] + cost[i, j])
    least = np.inf
    for subset in range(size):
        count = 0
        for j in range(m):
            count += subset >> j & 1
        if count == k:
            least = min(least, best[subset])
    return least


def objective(moved, target, allowed, k):
    """Least sum of squared distances of k pairs of allowed points."""
    cost = ((moved[:, None] - target[None]) ** 2).sum(axis=-1)
    return cheapest_matching(cost, allowed, k)


# --- 3D norm space: a Lipschitz enclosure --------------------------------------------------------


@jit
def norm_objective(source, norms, allowed, k, t):
    """Least sum of k allowed (|x_i + t| - |y_j|)^2 in different rows and columns."""
    cost = np.empty((source.shape[0], norms.size))
    for i in range(source.shape[0]):
        a, b, c = source[i, 0] + t[0], source[i, 1] + t[1], source[i, 2] + t[2]
        norm = math.sqrt(a * a + b * b + c * c)
        for j in range(norms.size):
            cost[i, j] = (norm - norms[j]) ** 2
    if allowed.all():
        return _cheapest_in_order(cost, norms, k)
    return cheapest_matching(cost, allowed, k)


@jit
def _cheapest_in_order(cost, norms, k):
    """The same without forbidden pairs: on a line some optimal matching keeps the order.

    Columns ascend in `norms`; so do rows when sorted by what they pay more for the greatest norm than
    for the least: (a - b)^2 - (a - c)^2 falls in a for b > c.
    """
    n, m = cost.shape
    rows = np.argsort(cost[:, 0] - cost[:, m - 1])
    table = np.full((m + 1, k + 1), np.inf)  # cheapest c pairs in the rows so far, first j columns
    table[:, 0] = 0.0
    for i in range(n):
        for c in range(min(i + 1, k), 0, -1):
            for j in range(m, 0, -1):
                table[j, c] = min(table[j, c], table[j - 1, c - 1] + cost[rows[i], j - 1])
            for j in range(1, m + 1):
                table[j, c] = min(table[j, c], table[j - 1, c])
    return table[m, k]


@jit
def enclose_norm3d(source, norms, allowed, k, tolerance, max_cubes):
    """Lower and upper bound on the least norm objective, `tolerance` apart unless `max_cubes` ran out.

    An optimal translation is a mean of |y| u - x over the pairs, u unit vectors: that bounds the start.
    """
    half = norms.max()
    for i in range(source.shape[0]):
        half = max(half, norms.max() + math.sqrt((source[i] ** 2).sum()))
    centres, reach = np.zeros((1, 3)), half
    upper, n_cubes = np.inf, 0
    while True:
        roots = np.empty(len(centres))
        for at in range(len(centres)):
            roots[at] = math.sqrt(norm_objective(source, norms, allowed, k, centres[at]))
        n_cubes += len(centres)
        upper = min(
            upper, _descend(source, norms, allowed, k, centres[np.argmin(roots)], half, reach)
        )
        lows = np.maximum(0.0, roots - math.sqrt(3.0 * k) * half) ** 2
        is_open = lows < upper - tolerance
        if not is_open.any():
            return upper - tolerance, upper
        if n_cubes + 8 * is_open.sum() > max_cubes:
            return max(0.0, lows[is_open].min()), upper
        half /= 2.0
        parents = centres[is_open]
        centres = np.empty((8 * len(parents), 3))
        for at in range(len(centres)):
            for a in range(3):
                centres[at, a] = parents[at // 8, a] + (half if at >> a & 1 else -half)


@jit
def _descend(source, norms, allowed, k, t, step, reach):
    """Compass search: slow, and free of whatever a cleverer descent could get wrong."""
    t = t.copy()
    value = norm_objective(source, norms, allowed, k, t)
    while step > 1e-8 * reach:
        moved = False
        for a in range(3):
            for sign in (-1.0, 1.0):
                t[a] += sign * step
                trial = norm_objective(source, norms, allowed, k, t)
                if trial < value:
                    value, moved = trial, True
                else:
                    t[a] -= sign * step
        if not moved:
            step /= 2.0
    return value
