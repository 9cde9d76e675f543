"""A list of matches as kernels receive it, and scores of poses over it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.jit import jit, jit_part


class MatchList(NamedTuple):
    """N matches: the k-th pairs `source[k]` with `target[k]`.

    Attributes
    ----------
    source, target : (N, 3) arrays
    rows, columns : (N,) int arrays
        Indices of the distinct points of either cloud, from 0.
    n_rows, n_columns : int
        Numbers of distinct points.
    reach : float
        Residual above which a match counts as wrong.
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
    """Return 1 for a residual of zero and 0 from `reach` on, quadratic between."""
    return 1.0 - (distance / reach) ** 2 if distance < reach else 0.0


@jit
def scores(matches, poses, out):
    """Write upper bounds on the score of (P, 3, 4) poses, that of the best one-to-one matching.

    The bound is the smaller of two sums: over the best match of each source point, and of each target
    point. It equals the score if no match competes at both of its ends.
    """
    by_row, by_column = np.zeros(matches.n_rows), np.zeros(matches.n_columns)
    x, y = matches.source, matches.target
    for p in range(poses.shape[0]):
        T = poses[p]
        by_row.fill(0.0)
        by_column.fill(0.0)
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
