"""A list of matches as the kernels see it, and how well poses agree with it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.jit import jit, jit_part


class MatchList(NamedTuple):
    """N matches: the k-th says that `source[k]` belongs to `target[k]`.

    Attributes
    ----------
    source, target : (N, 3) arrays
    rows, columns : (N,) int arrays
        Which point of either cloud it is, numbered from 0: equal numbers, equal points.
    n_rows, n_columns : int
        How many different points there are.
    reach : float
        Residual from which on a match counts as wrong.
    """

    source: np.ndarray
    target: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    n_rows: int
    n_columns: int
    reach: float


@jit_part
def agreement(distance, reach):
    """1 for a residual of zero, 0 from `reach` on, quadratic between."""
    return 1.0 - (distance / reach) ** 2 if distance < reach else 0.0


@jit
def scores(matches, poses, out):
    """Upper bounds on the score of (P, 3, 4) poses, which is that of the best one-to-one matching.

    The best match of every source point is counted, then that of every target point, and the lesser sum
    taken: it is the score itself where no match competes at both of its ends.
    """
    by_row, by_column = np.zeros(matches.n_rows), np.zeros(matches.n_columns)
    x, y = matches.source, matches.target
    for p in range(poses.shape[0]):
        T = poses[p]
        by_row[:] = 0.0
        by_column[:] = 0.0
        for k in range(x.shape[0]):
            square = 0.0
            for a in range(3):
                moved = T[a, 0] * x[k, 0] + T[a, 1] * x[k, 1] + T[a, 2] * x[k, 2] + T[a, 3]
                square += (moved - y[k, a]) ** 2
            gain = agreement(math.sqrt(square), matches.reach)
            i, j = matches.rows[k], matches.columns[k]
            by_row[i] = max(by_row[i], gain)
            by_column[j] = max(by_column[j], gain)
        out[p] = min(by_row.sum(), by_column.sum())
