"""What kernels add to the squared residuals of pairs, and by what they multiply the sum."""

from __future__ import annotations

import numpy as np

from dcreg.families.kernels import Clouds
from dcreg.problem import PairWeights


def infeasibility_penalty(
    candidates: np.ndarray | None, n_inliers: int, extent: float
) -> np.ndarray:
    """Return the additional cost of each pair: 0, or more than the cost of any feasible matching.

    Parameters
    ----------
    candidates : (n, m) bool array or None
        The feasible pairs; None: all, and the result is empty.
    n_inliers : int
    extent : float
        Sum of the maximum distances of the source, at its maximum scale, and of the target from the
        origin. No residual of an admissible pose exceeds ``2 sqrt(2) extent``, so one infeasible pair
        costs more than any matching without one.
    """
    if candidates is None:
        return np.empty((0, 0))
    return np.where(candidates, 0.0, 16.0 * n_inliers * extent**2)


def weighted_clouds(clouds: Clouds, weights: PairWeights) -> Clouds:
    """Return clouds for kernels with the weights of pairs."""
    factors, extra, penalty = weights.factors, weights.extra, clouds.infeasibility_penalty
    if penalty.size:  # still more than the cost of any feasible matching
        extra = extra + np.where(penalty > 0.0, penalty + clouds.k * extra.max(), 0.0)
    # kernels multiply the penalty by the weight, too
    return clouds._replace(
        infeasibility_penalty=np.ascontiguousarray(extra / factors),
        weights=np.ascontiguousarray(factors),
        heaviest=factors.max(axis=1),
    )
