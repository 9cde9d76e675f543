"""Exact k-cardinality assignment, checked: the public face of `dcreg.assignment.kernels.dense`."""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.jit import NEVER


def k_assignment(cost: np.ndarray, k: int, stop: np.ndarray = NEVER) -> tuple[float, np.ndarray]:
    """Cheapest one-to-one choice of exactly k pairs in a dense cost matrix.

    Minimises ``sum_ij p_ij cost_ij`` over binary P with row and column sums at most one and total k.
    The LP relaxation is integral, so this is also its optimum.

    Parameters
    ----------
    cost : (n, m) array of finite numbers, of any sign
    k : int, 1 <= k <= min(n, m)
    stop : (1,) uint8 array
        Set from another thread, it ends the call early; what is returned is then of no use.

    Returns
    -------
    value : float
    col_of : (n,) int array
        Column matched to each row, -1 where a row is unmatched.

    Raises
    ------
    ValueError
        When `cost` is not a finite matrix or k is out of range.
    """
    cost = np.ascontiguousarray(cost, dtype=np.float64)
    if cost.ndim != 2 or not np.isfinite(cost).all():
        raise ValueError("cost must be a matrix of finite numbers")
    if not 1 <= k <= min(cost.shape):
        raise ValueError(f"k={k} pairs asked of a {cost.shape[0]} x {cost.shape[1]} cost matrix")
    value, col_of, _ = cheapest_pairs(cost, int(k), stop)
    return float(value), col_of


def pairs_of(col_of: np.ndarray) -> np.ndarray:
    """(k, 2) matched pairs (row, column) of a `col_of` vector."""
    rows = np.flatnonzero(col_of >= 0)
    return np.stack([rows, col_of[rows]], axis=1).astype(np.int64)
