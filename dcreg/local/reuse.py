"""Pairs matched at one pose, used again for fewer pairs at a pose nearby: no point is looked up anew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcreg.kernels.points import NEVER
from dcreg.local.polish import objective

# The pairs are those of a pose too where they cost no more than this many times what they did on average.
_STILL_NEAR = 4.0


@dataclass(frozen=True)
class Matched:
    """One-to-one pairs, and the pose they were matched at.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
    pairs : (K, 2) int array
    value : float
        The sum of their squared residuals there.
    """

    T_target_source: np.ndarray
    pairs: np.ndarray
    value: float

    def cheapest(
        self, source: np.ndarray, target: np.ndarray, T: np.ndarray, k: int
    ) -> tuple[float, np.ndarray]:
        """The k of the pairs that cost least at the pose `T`, and the sum of their squared residuals."""
        d = source.shape[1]
        moved = source[self.pairs[:, 0]] @ T[:d, :d].T + T[:d, d]
        moved -= target[self.pairs[:, 1]]
        costs = np.einsum("ij,ij->i", moved, moved)
        kept = np.sort(np.argpartition(costs, k - 1)[:k])
        return float(costs[kept].sum()), self.pairs[kept]


def quick_objective(
    source: np.ndarray,
    target: np.ndarray,
    T_target_source: np.ndarray,
    n_inliers: int,
    candidates: np.ndarray | None = None,
    *,
    known: Matched | None,
    prove: bool = True,
    stop: np.ndarray = NEVER,
) -> tuple[float, np.ndarray]:
    """`objective`, but that once `stop` is set pairs of a pose nearby will do.

    Parameters
    ----------
    source, target, T_target_source, n_inliers, candidates, prove, stop
        As in `objective`.
    known : Matched, optional
        Feasible pairs, at least `n_inliers`.

    Returns
    -------
    value, assignment
        As in `objective`: the true value of these pairs, which bounds the least one from above.
    """
    if known is not None and stop[0]:
        value, pairs = known.cheapest(source, target, T_target_source, n_inliers)
        if value / n_inliers <= _STILL_NEAR * known.value / len(known.pairs):
            return value, pairs
    return objective(source, target, T_target_source, n_inliers, candidates, prove=prove, stop=stop)
