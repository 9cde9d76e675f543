"""Feasible pairs: which source point may be matched with which target point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from dcreg.problem.errors import InputError

# (n, m) mask, or one sequence of target indices per source point
Candidates = np.ndarray | Sequence[Sequence[int]]


@dataclass(frozen=True)
class FeasiblePairs:
    """The pairs that may be matched, as a search sees them.

    Attributes
    ----------
    mask : (n, m) bool array or None
        None: every pair.
    """

    mask: np.ndarray | None = None

    def prices(self, n_inliers: int, reach: float) -> np.ndarray:
        """What each pair costs beyond its residual: 0, or more than any feasible matching.

        Empty where every pair is feasible. `reach` is the sum of the greatest distances of the source,
        at its largest scale, and of the target from the origin: no residual of an admissible pose exceeds
        ``2 sqrt(2) reach``, so one such pair costs more than any matching without.
        """
        if self.mask is None:
            return np.empty((0, 0))
        return np.where(self.mask, 0.0, 16.0 * n_inliers * reach**2)


def check_candidates(candidates: Candidates, n: int, m: int, n_inliers: int) -> np.ndarray | None:
    """The feasible pairs as an (n, m) mask; None where every pair is feasible.

    Raises
    ------
    InputError
        For a wrong shape, an index outside the target, or pairs that admit no matching of
        `n_inliers`.
    """
    if isinstance(candidates, np.ndarray) and candidates.ndim == 2 and candidates.dtype == bool:
        mask = candidates.copy()
        if mask.shape != (n, m):
            raise InputError(
                f"candidates: mask of shape {mask.shape}; {n} source and {m} target points need "
                f"({n}, {m})"
            )
    else:
        mask = _mask_of_lists(candidates, n, m)
    most = int((maximum_bipartite_matching(csr_array(mask), perm_type="column") >= 0).sum())
    if most < n_inliers:
        raise InputError(
            f"candidates: at most {most} pairs can be matched one to one, fewer than n_inliers = "
            f"{n_inliers}; allow more pairs or lower n_inliers"
        )
    return None if mask.all() else mask


def _mask_of_lists(candidates: Candidates, n: int, m: int) -> np.ndarray:
    try:
        rows = [np.asarray(row, dtype=np.float64).ravel() for row in candidates]
    except (TypeError, ValueError):
        raise InputError(
            "candidates: neither a boolean mask nor one sequence of target indices per source point"
        ) from None
    if len(rows) != n:
        raise InputError(
            f"candidates: {len(rows)} index lists for {n} source points; give one each"
        )
    mask = np.zeros((n, m), dtype=bool)
    for i, row in enumerate(rows):
        bad = row[(row != np.round(row)) | (row < 0) | (row >= m)]
        if bad.size:
            raise InputError(
                f"candidates: {bad[0]:g} for source point {i} is no target index; "
                f"use integers from 0 to {m - 1}"
            )
        mask[i, row.astype(np.int64)] = True
    return mask
