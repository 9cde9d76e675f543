"""The unit of length of a problem, and the gap to which a search closes by default."""

from __future__ import annotations

import numpy as np

TOLERATED_RESIDUAL = 0.03  # RMS residual per pair, in RMS radii of the target
# The same of norms, which fit far better than points: as much as little noise leaves.
TOLERATED_NORM_RESIDUAL = 0.003


def rms_radius(points: np.ndarray) -> float:
    """Root mean square distance of the points from their centroid.

    0 where they differ by no more than the rounding of their coordinates: that is no unit of length.
    """
    spread = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return spread if spread > 1e-13 * np.abs(points).max() else 0.0


def unit_length(source: np.ndarray, target: np.ndarray) -> float:
    """RMS radius of the target; of the source where the target has no extent; 0 if neither has."""
    return rms_radius(target) or rms_radius(source)


def default_gap_tol(
    source: np.ndarray, target: np.ndarray, n_inliers: int, factor: float = TOLERATED_RESIDUAL
) -> float:
    """Absolute tolerance on the gap of the objective, a sum over `n_inliers` squared residuals.

    ``n_inliers * (factor * r)^2``, where r is the RMS radius of the target, or of the source where
    the target has no extent.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
    n_inliers : int
    factor : float
        Tolerated RMS residual per pair, in units of r.

    Returns
    -------
    float
        In squared units of the target.
    """
    return float(n_inliers * (factor * unit_length(source, target)) ** 2)
