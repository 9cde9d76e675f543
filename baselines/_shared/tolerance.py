"""The absolute tolerance, or epsilon, of methods with a separate search."""

from __future__ import annotations

import numpy as np

from dcreg.problem import rms_radius


def absolute_tolerance(target: np.ndarray, n_inliers: int, factor: float) -> float:
    """Return ``n_inliers * (factor * r)^2``, where r is the RMS radius of the target.

    Parameters
    ----------
    target : (m, d) array
    n_inliers : int
    factor : float
        Tolerated RMS residual per pair, in RMS radii of the target.

    Returns
    -------
    float
        In squared units of `target`.
    """
    return float(n_inliers * (factor * rms_radius(target)) ** 2)
