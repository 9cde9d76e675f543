"""Checks of what a certificate states, before its bounds are proven."""

from __future__ import annotations

import numpy as np

from dcreg.certificate.format import PRUNED, Certificate, CertificateError, require
from dcreg.certificate.objective import Objective


def exact_up_to(c: Certificate, source: np.ndarray, target: np.ndarray) -> float:
    """Return the objective up to which a fit counts as exact, in normalised units."""
    last_bits = 16.0 * np.finfo(float).eps * max(np.abs(source).max(), np.abs(target).max())
    # few points far from all others must not raise the limit
    typical = np.sqrt(np.median(((target - np.median(target, axis=0)) ** 2).sum(axis=1)))
    length = min(1.0, 3.0 * typical / c.unit) or 1.0
    return float(c.n_inliers * (1e-12 * length**2 + 100.0 * (last_bits / c.unit) ** 2))


def check_claim(c: Certificate, slack: float, exact: float) -> None:
    """Check that the bounds of the leaves, if true, imply the stated lower bound and status."""
    area = c.unit**2
    stated = f"lower_bound {c.lower_bound * area:.9g}"
    require(
        0 <= c.lower_bound <= c.upper_bound + slack,
        f"{stated} does not lie in [0, upper_bound {c.upper_bound * area:.9g}]",
    )
    lowest = int(c.leaf_bounds.argmin())
    minimum = c.leaf_bounds[lowest]
    require(
        c.lower_bound <= minimum + slack,
        f"{stated} does not follow: leaf {lowest} has the bound {minimum * area:.9g}",
    )
    threshold = c.upper_bound * (1.0 - 1e-9) - c.gap_tol - slack
    if c.status == "optimal" and c.lower_bound < threshold:
        raise CertificateError("status optimal does not follow: the gap exceeds gap_tol")
    require(
        c.status != "optimal" or c.lower_bound > 0.0 or c.upper_bound <= exact * (1.0 + 1e-6),
        "status optimal does not follow: the lower bound is 0, which holds for every sum of squares",
    )
    early = np.flatnonzero((c.leaf_reasons == PRUNED) & (c.leaf_bounds < threshold))
    if early.size:
        raise CertificateError(
            f"leaf {early[0]} was pruned with the bound {c.leaf_bounds[early[0]] * area:.9g}, "
            f"below upper_bound - gap_tol = {(c.upper_bound - c.gap_tol) * area:.9g}"
        )


def check_start_box(objective: Objective, lower: np.ndarray, upper: np.ndarray) -> None:
    """Check that the start box contains a region, computed here, that contains every optimum.

    A box much larger than the clouds is refused: the rounding errors of its bounds exceed the tolerance.
    """
    need_lower, need_upper = objective.region()
    largest = 2.0 * objective.largest_parameter
    is_small = np.maximum(-lower, upper).max() <= largest
    require(
        is_small, f"start box: larger than {largest:.9g} (normalised), much larger than the clouds"
    )
    tolerance = 1e-9 * (1.0 + np.abs(need_upper) + np.abs(need_lower))
    short = np.flatnonzero((lower > need_lower + tolerance) | (upper < need_upper - tolerance))
    if short.size:
        axis = short[0]
        raise CertificateError(
            f"start box: axis {axis} spans [{lower[axis]:.9g}, {upper[axis]:.9g}], but an optimum "
            f"may lie anywhere in [{need_lower[axis]:.9g}, {need_upper[axis]:.9g}] (normalised)"
        )
