"""The unit of length of a problem, and the gap to which a search closes by default."""

from __future__ import annotations

import math

import numpy as np

from dcreg.problem.errors import InputError

TOLERATED_RESIDUAL = 0.03  # RMS residual per pair, in RMS radii of the target
# The same of norms, which fit far better than points: as much as little noise leaves.
TOLERATED_NORM_RESIDUAL = 0.003
EXACT = 1e-9  # a squared residual this small, in squared RMS radii, is rounding


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


def gap_tol_of(tol: float | None, gap_tol: float | None, n_inliers: int) -> float | None:
    """The absolute tolerance on the gap, where it may be given as a length per pair.

    Parameters
    ----------
    tol : float, optional
        Tolerated RMS residual per pair, in units of the target.
    gap_tol : float, optional
        The tolerance itself.
    n_inliers : int

    Returns
    -------
    float or None
        ``n_inliers * tol^2`` or `gap_tol`; None where neither is given.

    Raises
    ------
    InputError
        If both are given, or `tol` is not a finite length.
    """
    if tol is None:
        return gap_tol
    if gap_tol is not None:
        raise InputError(
            f"tol: {tol}, and gap_tol: {gap_tol} as well; give one of them (gap_tol = K * tol^2)"
        )
    if isinstance(tol, bool) or not (tol >= 0 and math.isfinite(n_inliers * tol * tol)):
        raise InputError(
            f"tol: {tol} is not a usable value; give a length in units of the target, such as 0.01"
        )
    return float(n_inliers * tol * tol)
