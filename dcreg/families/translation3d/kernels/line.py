"""The objective over norms if every pair is feasible: an assignment of scalars, without a matrix."""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.line import line_matching, line_value
from dcreg.assignment.kernels.sorting import COLUMNS, sort_columns
from dcreg.jit import jit, jit_part


def match_on_line(a, b, k):
    """Return value and column of every row (-1: unmatched) of the cheapest k pairs, cost (a_i -
    b_j)^2."""
    by_a, by_b = np.argsort(a, kind="stable"), np.argsort(b, kind="stable")
    matched = line_matching(a[by_a], b[by_b], k)
    rows, chosen = by_a[matched >= 0], by_b[matched[matched >= 0]]
    col_of = np.full(a.size, -1)
    col_of[rows] = chosen
    return float(((a[rows] - b[chosen]) ** 2).sum()), col_of


@jit
def objectives_on_line(source, ordered, k, thetas, values):
    """Write E at every row of `thetas` from the (3, n) source and the sorted norms of the target.

    Several rows are sorted at once, because sorting is most of the work. Each value is the same to the
    last bit for any grouping of the rows, so threads may cut `thetas` anywhere.
    """
    n, rows = source.shape[1], thetas.shape[0]
    norms, table, shifts = np.empty(n), np.empty((n, COLUMNS)), np.empty((3, COLUMNS))
    for first in range(0, rows, COLUMNS):
        for column in range(COLUMNS):  # beyond the last row, it is repeated
            for a in range(3):
                shifts[a, column] = thetas[min(first + column, rows - 1), a]
        _norm_columns(source, shifts, table)
        sort_columns(table)
        for column in range(min(COLUMNS, rows - first)):
            for i in range(n):
                norms[i] = table[i, column]
            values[first + column] = line_value(norms, ordered, k)
    return rows


@jit_part
def _norm_columns(source, shifts, table):
    """Fill ``|x_i + t|`` for several t at once: the `COLUMNS` columns of `shifts` and of `table`."""
    for i in range(source.shape[1]):
        x, y, z = source[0, i], source[1, i], source[2, i]
        for column in range(COLUMNS):
            a, b, c = x + shifts[0, column], y + shifts[1, column], z + shifts[2, column]
            table[i, column] = a * a + b * b + c * c
    numbers = table.reshape(-1)
    for at in range(numbers.size):  # a separate loop, because the roots vectorise only then
        numbers[at] = math.sqrt(numbers[at])
