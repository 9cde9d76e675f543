"""Check a certificate in plain NumPy and SciPy, without the code that searched for it.

Neither this module nor what it imports uses the library's search, bounds, spaces or kernels, so that a
mistake there cannot hide itself. The checks, in order: the certificate is whole and speaks of these
clouds; its entries agree with each other; its start box holds every optimum; its leaves tile the start
box (`cover`); the stated optimum is attained; no sampled parameter beats its leaf; and on every leaf the
stated lower bound is proven anew (`proof`, by the plain bounds of `families`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from dcreg.certificate.cover import check_cover
from dcreg.certificate.families import FAMILIES, Family
from dcreg.certificate.format import (
    PRUNED,
    Certificate,
    CertificateError,
    NoCertificateError,
    check_shapes,
    digest,
    read,
)
from dcreg.certificate.proof import Progress, Proof

MAX_DENSE = 4_000_000  # pairs of which cost matrices are formed


@dataclass
class Report:
    """What `verify` found. Bounds are in squared units of the target, as in `dcreg.Result`.

    Attributes
    ----------
    accepted : bool
    is_certificate : bool
        Whether there was a certificate to be checked: neither another file nor none.
    reason : str
        Why the certificate was refused; empty if it was accepted.
    statement : str
        What is now known to hold; empty if refused.
    is_trivial : bool
        Whether the lower bound is 0, as of any sum of squares, and the upper one is not.
    checks : list of str
        One line per check that was passed.
    model : str
        Family of poses that the certificate speaks of.
    n_inliers : int
    lower_bound, upper_bound, gap_tol : float
        As stated by the certificate; proven only if it was accepted.
    n_leaves, n_boxes, n_assignments : int
        Leaves of the certificate, boxes they were cut into for the proof, assignments solved.
    time_s : float
        Wall time of the check.
    """

    accepted: bool = False
    is_certificate: bool = True
    reason: str = ""
    statement: str = ""
    is_trivial: bool = False
    checks: list[str] = field(default_factory=list)
    model: str = ""
    n_inliers: int = 0
    lower_bound: float = np.nan
    upper_bound: float = np.nan
    gap_tol: float = np.nan
    n_leaves: int = 0
    n_boxes: int = 0
    n_assignments: int = 0
    time_s: float = 0.0


def verify(
    certificate: str | Path | Certificate | None,
    source: np.ndarray,
    target: np.ndarray,
    *,
    max_boxes: int | None = None,
    n_samples: int = 500,
    progress: Progress | None = None,
) -> Report:
    """Check a certificate against the clouds it should speak of, without trusting the search.

    Whoever trusts this function, NumPy and SciPy need not trust `dcreg.register`: an accepted
    certificate encloses the global optimum of its objective between ``lower_bound`` and ``upper_bound``.

    Parameters
    ----------
    certificate : path or Certificate
        A file written by `dcreg.certificate.write`, or `Result.certificate` of a run.
    source, target : (n, d), (m, d) arrays
        As they were given to `dcreg.register`, to the last bit.
    max_boxes : int, optional
        Boxes to be bounded before the proof counts as failed; default 1000 plus 20 per leaf.
    n_samples : int
        Random parameters tried against the leaf bounds.
    progress : callable, optional
        Called with the number of boxes bounded and of those known to be needed, which may grow.

    Returns
    -------
    Report
        A bad certificate raises nothing: it is refused, with the reason.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((12, 2))
    >>> options = dcreg.SolveOptions(certificate=True)
    >>> result = dcreg.register(
    ...     points, points + 3.0, n_inliers=12, model="similarity2d", options=options
    ... )
    >>> dcreg.verify(result.certificate, points, points + 3.0).accepted
    True
    """
    began = time.perf_counter()
    report = Report()
    try:
        if certificate is None:
            raise CertificateError("certificate: None; register with certificate=True to have one")
        if isinstance(certificate, Certificate):
            check_shapes(certificate)
            report.checks.append(f"complete: {len(certificate.leaf_bounds)} leaves")
        else:
            certificate = read(certificate)
            n_leaves = len(certificate.leaf_bounds)
            report.checks.append(f"complete and unchanged: {n_leaves} leaves, sealed")
        _check(
            report, certificate, np.asarray(source, dtype=np.float64),
            np.asarray(target, dtype=np.float64), max_boxes, n_samples, progress,
        )  # fmt: skip
        report.accepted = True
    except CertificateError as error:
        report.reason = str(error)
        report.is_certificate = not isinstance(error, NoCertificateError)
    report.time_s = time.perf_counter() - began
    return report


def _check(
    report: Report,
    c: Certificate,
    source: np.ndarray,
    target: np.ndarray,
    max_boxes: int | None,
    n_samples: int,
    progress: Progress | None,
) -> None:
    """All checks but that of the file; each passed one is noted in `report`."""
    check_clouds(c, source, target)
    report.checks.append(f"made for these clouds: {len(source)} and {len(target)} points")

    area = c.unit**2
    report.model, report.n_inliers, report.n_leaves = c.model, c.n_inliers, len(c.leaf_bounds)
    report.lower_bound, report.upper_bound = c.lower_bound * area, c.upper_bound * area
    report.gap_tol = c.gap_tol * area

    family = family_of(c, source, target)
    # rounding: relative to the claim, and to a residual of the size of the cloud
    slack = 1e-9 * abs(c.lower_bound) + 1e-12 * c.n_inliers
    check_claim(c, slack)
    report.checks.append("stated bounds, reasons and tolerance agree with each other")
    check_start_box(family, c.start_lower, c.start_upper)
    report.checks.append("the start box holds every optimum")
    check_cover(c.start_lower, c.start_upper, c.leaf_lower, c.leaf_upper)
    report.checks.append("the leaves tile the start box")
    try:
        check_optimum(family, c, slack)
        report.checks.append(f"the stated parameter attains {report.upper_bound:.9g}")
        tried = check_samples(family, c, slack, n_samples)
        report.checks.append(f"none of {tried} sampled parameters beats its leaf")
        proof = Proof(family, slack, max_boxes or 1000 + 20 * len(c.leaf_bounds), progress)
        report.n_boxes = proof.run(c)
    finally:
        report.n_assignments = family.n_assignments
    report.checks.append(
        f"on every leaf the objective is at least {report.lower_bound:.9g}, "
        f"proven on {report.n_boxes} boxes"
    )
    among = f" among {len(c.candidates)} candidates" if len(c.candidates) else ""
    report.statement = (
        f"{family.scope}: the least sum over {c.n_inliers} one-to-one pairs{among} of squared "
        f"residuals lies in [{report.lower_bound:.9g}, {report.upper_bound:.9g}]"
    )
    report.is_trivial = c.lower_bound <= 0.0 and c.upper_bound > slack


# --- the clouds -------------------------------------------------------------------------------


def check_clouds(c: Certificate, source: np.ndarray, target: np.ndarray) -> None:
    """The certificate was made for these very clouds, in the frame of their centres and size."""
    for name, points, stated in (
        ("source", source, c.source_digest),
        ("target", target, c.target_digest),
    ):
        if digest(points) != stated:
            raise CertificateError(f"{name}: other data than the certificate was made for")
        if points.ndim != 2 or points.shape[1] != len(c.source_centre):
            raise CertificateError(f"{name}: shape {points.shape} does not fit model {c.model!r}")
    if c.n_inliers > min(len(source), len(target)):
        raise CertificateError(f"n_inliers: {c.n_inliers} exceeds the smaller cloud")
    # in another unit, rounding would be of another size than the claims
    unit = _extent(target) or _extent(source) or 1.0
    if not abs(c.unit - unit) <= 1e-6 * unit:
        raise CertificateError(f"unit: {c.unit:.9g} stated, but the clouds measure {unit:.9g}")
    for name, points, centre in (
        ("source", source, c.source_centre),
        ("target", target, c.target_centre),
    ):
        mean = points.mean(axis=0)
        if not (np.abs(centre - mean) <= 1e-6 * unit + 1e-12 * np.abs(points).max()).all():
            raise CertificateError(f"{name}_centre: {centre} stated, but it is {mean}")


def _extent(points: np.ndarray) -> float:
    """RMS distance to the centre; 0 where it is rounding."""
    extent = float(np.sqrt(points.var(axis=0).sum()))
    return extent if extent > 1e-13 * np.abs(points).max() else 0.0


def family_of(c: Certificate, source: np.ndarray, target: np.ndarray) -> Family:
    """The objective that the certificate speaks of, over normalised clouds."""
    n, m = len(source), len(target)
    is_dense = n * m <= MAX_DENSE
    family = FAMILIES[c.model](
        (source - c.source_centre) / c.unit,
        (target - c.target_centre) / c.unit,
        c.n_inliers,
        tuple(c.scale_range),
        feasible_pairs(c, n, m) if is_dense else None,
    )
    if not is_dense and (len(c.candidates) or not family.is_sorted_order):
        raise CertificateError(f"cannot be checked: {n} x {m} pairs exceed {MAX_DENSE:,}")
    return family


def feasible_pairs(c: Certificate, n: int, m: int) -> np.ndarray | None:
    """(n, m) mask of the candidates, None where every pair is feasible."""
    if not len(c.candidates):
        return None
    if (c.candidates >= (n, m)).any():
        raise CertificateError("candidates: an index beyond the clouds")
    mask = np.zeros((n, m), dtype=bool)
    mask[tuple(c.candidates.T)] = True
    if (maximum_bipartite_matching(csr_array(mask)) >= 0).sum() < c.n_inliers:
        raise CertificateError(f"candidates: no {c.n_inliers} of them are one to one")
    return mask


# --- the statement ----------------------------------------------------------------------------


def check_claim(c: Certificate, slack: float) -> None:
    """The leaves' bounds, if true, imply the stated lower bound, and the status follows."""
    if not 0 <= c.lower_bound <= c.upper_bound + slack:
        raise CertificateError(
            f"lower_bound {c.lower_bound:.9g} does not lie in [0, upper_bound {c.upper_bound:.9g}]"
        )
    least = c.leaf_bounds.min()
    if c.lower_bound > least + slack:
        raise CertificateError(
            f"lower_bound {c.lower_bound:.9g} does not follow: leaf {int(c.leaf_bounds.argmin())} "
            f"has the bound {least:.9g}"
        )
    threshold = c.upper_bound * (1.0 - 1e-9) - c.gap_tol - slack
    if c.status == "optimal" and c.lower_bound < threshold:
        raise CertificateError("status optimal does not follow: the gap exceeds gap_tol")
    early = np.flatnonzero((c.leaf_reasons == PRUNED) & (c.leaf_bounds < threshold))
    if early.size:
        raise CertificateError(
            f"leaf {early[0]} was pruned with the bound {c.leaf_bounds[early[0]]:.9g}, "
            f"below upper_bound - gap_tol = {c.upper_bound - c.gap_tol:.9g}"
        )


def check_start_box(family: Family, lower: np.ndarray, upper: np.ndarray) -> None:
    """No optimum lies outside of the start box, by a region computed here."""
    need_lower, need_upper = family.region()
    tolerance = 1e-9 * (1.0 + np.abs(need_upper) + np.abs(need_lower))
    short = np.flatnonzero((lower > need_lower + tolerance) | (upper < need_upper - tolerance))
    if short.size:
        axis = short[0]
        raise CertificateError(
            f"start box: axis {axis} spans [{lower[axis]:.9g}, {upper[axis]:.9g}], but an optimum "
            f"may lie anywhere in [{need_lower[axis]:.9g}, {need_upper[axis]:.9g}]"
        )


# --- the values -------------------------------------------------------------------------------


def check_optimum(family: Family, c: Certificate, slack: float) -> None:
    """`theta` is a pose of the family, attains the stated upper bound, and beats no leaf around it."""
    if not family.admissible(c.theta[None])[0]:
        raise CertificateError("theta: not an admissible parameter")
    value = family.objective(c.theta)
    if not abs(value - c.upper_bound) <= 1e-9 * c.upper_bound + slack:
        raise CertificateError(
            f"upper_bound: {c.upper_bound:.9g} stated, but the objective at theta is {value:.9g}"
        )
    holds_it = ((c.leaf_lower <= c.theta) & (c.theta <= c.leaf_upper)).all(axis=1)
    around = np.flatnonzero(holds_it)
    # at its exact value, computed once
    false = around[value < c.leaf_bounds[around] - slack]
    family.refute(np.tile(c.theta, (len(false), 1)), c.leaf_bounds[false] - slack, false)


def check_samples(family: Family, c: Certificate, slack: float, n_samples: int) -> int:
    """No random parameter of a random leaf has an objective below the leaf's bound; how many."""
    generator = np.random.default_rng(0)
    leaves = generator.integers(len(c.leaf_bounds), size=n_samples)
    share = generator.random((n_samples, c.leaf_lower.shape[1]))
    thetas = c.leaf_lower[leaves] + share * (c.leaf_upper - c.leaf_lower)[leaves]
    admissible = np.flatnonzero(family.admissible(thetas))
    # a sum of squares beats no bound of 0
    tried = admissible[c.leaf_bounds[leaves[admissible]] > slack]
    family.refute(thetas[tried], c.leaf_bounds[leaves[tried]] - slack, leaves[tried])
    return len(admissible)
