"""Check a certificate in NumPy, and SciPy for assignments, without the code of the search.

Neither this module nor its imports use the library's search, bounds, spaces or kernels, so that an error
there cannot remain hidden. The checks, in order: the certificate is complete and refers to these clouds;
its entries are consistent; its start box contains every optimum; its leaves are a partition of the start
box; the stated optimum is attained; no sampled parameter is below the bound of its leaf; and the stated
lower bound is proven again on every leaf (`proof`, with the simple bounds of `objectives`). If that takes
too many boxes, the smaller bound that the stated tolerance permits is proven instead.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from dcreg import text
from dcreg.certificate.exact import ExactProof, interval
from dcreg.certificate.format import (
    Certificate,
    CertificateError,
    NothingToCheckError,
    UnprovenError,
    check_shapes,
    digest,
    read,
    require,
)
from dcreg.certificate.objective import Objective
from dcreg.certificate.objectives import OBJECTIVES
from dcreg.certificate.proof import Progress, Proof, check_partition
from dcreg.certificate.report import Report, pose_of
from dcreg.certificate.rigid_proof import RigidProof
from dcreg.certificate.statement import check_claim, check_start_box, exact_up_to

EXACT_MODEL = "similarity2d"  # the bounds of others need roots
NEGLIGIBLE = 1e-6  # share of a lower bound up to which the tolerance for rounding is not subtracted
MAX_DENSE = 4_000_000  # pairs of points up to which cost matrices are formed


def verify(
    certificate: str | Path | Certificate | None,
    source: np.ndarray,
    target: np.ndarray,
    *,
    max_boxes: int | None = None,
    n_samples: int = 500,
    exact: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Check a certificate against its clouds, independently of the search.

    An accepted certificate proves that the global optimum of its objective lies between ``lower_bound``
    and ``upper_bound``. The proof relies on this function, NumPy and SciPy, not on `dcreg.register`.

    Parameters
    ----------
    certificate : path or Certificate
        A file written by `dcreg.certificate.write`, or `Result.certificate` of a run.
    source, target : (n, d), (m, d) arrays
        Exactly as given to `dcreg.register`.
    max_boxes : int, optional
        The proof of a bound fails after this number of boxes; default 1000 plus 20 per leaf, or 60 for
        rigid 3D poses. The smaller bound ``upper_bound - gap_tol`` is then tried with as many.
    n_samples : int
        Number of random parameters that are compared with the bounds of their leaves.
    exact : bool
        Also prove both bounds in integers, so that no conclusion depends on rounding. Model
        ``similarity2d`` only.
    progress : callable, optional
        Called with the number of boxes bounded and the number known to be needed, which may increase.

    Returns
    -------
    Report
        A bad certificate raises no exception; `reason` states why it was rejected.

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
            raise CertificateError(
                "certificate: None; register with SolveOptions(certificate=True) to record one"
            )
        if isinstance(certificate, Certificate):
            check_shapes(certificate)
            n_leaves = text.count(len(certificate.leaf_bounds), "leaf", "leaves")
            report.checks.append(f"complete: {n_leaves}")
        else:
            certificate = read(certificate)
            n_leaves = text.count(len(certificate.leaf_bounds), "leaf", "leaves")
            report.checks.append(f"complete and unchanged: {n_leaves}, with the right checksum")
        _check(
            report, certificate, np.asarray(source, dtype=np.float64),
            np.asarray(target, dtype=np.float64), max_boxes, n_samples, exact, progress,
        )  # fmt: skip
        report.accepted = True
    except CertificateError as error:
        report.reason = str(error)
        report.is_certificate = not isinstance(error, NothingToCheckError)
    report.time_s = time.perf_counter() - began
    return report


def _check(
    report: Report,
    c: Certificate,
    source: np.ndarray,
    target: np.ndarray,
    max_boxes: int | None,
    n_samples: int,
    exact: bool,
    progress: Progress | None,
) -> None:
    """Run all checks except that of the file; list each check passed in `report`."""
    if exact and c.model != EXACT_MODEL:
        raise NothingToCheckError(
            f"exact: no exact check for model {c.model!r}, only for {EXACT_MODEL!r}; verify without it"
        )
    check_clouds(c, source, target)
    report.checks.append(f"made for these clouds: {len(source)} and {len(target)} points")

    area = c.unit**2
    report.model, report.n_inliers, report.n_leaves = c.model, c.n_inliers, len(c.leaf_bounds)
    report.lower_bound, report.upper_bound = c.lower_bound * area, c.upper_bound * area
    report.gap_tol = c.gap_tol * area

    objective = objective_of(c, source, target)
    # rounding: relative to the claim, and to a residual of the size of the cloud
    slack = 1e-9 * abs(c.lower_bound) + 1e-12 * c.n_inliers + objective.rounding
    exact_fit = exact_up_to(c, source, target)
    check_claim(c, slack, exact_fit)
    report.checks.append("the stated bounds, reasons and tolerance are consistent")
    if objective.only_optima:  # then no single pose contradicts more than the claim
        most = max(c.lower_bound, c.upper_bound - c.gap_tol) + slack
        high = np.flatnonzero(c.leaf_bounds > most)
        require(not high.size, f"leaf_bounds: leaf {high[:1]} states more than the claim needs")
        c = replace(c, leaf_bounds=np.minimum(c.leaf_bounds, c.lower_bound))
    check_start_box(objective, c.start_lower, c.start_upper)
    report.checks.append("the start box contains every optimum")
    for lower, upper, leaves in objective.roots(c):
        check_partition(lower, upper, c.leaf_lower[leaves], c.leaf_upper[leaves], leaves)
    report.checks.append("the leaves are a partition of the start box")
    try:
        check_optimum(objective, c, slack)
        report.T_target_source = pose_of(c, is_swapped=len(source) > len(target))
        report.checks.append(f"the stated parameter attains {report.upper_bound:.9g}")
        tried = check_samples(objective, c, slack, n_samples)
        report.checks.append(f"none of {tried} sampled parameters is below the bound of its leaf")
        most = max_boxes or 1000 + objective.boxes_per_leaf * len(c.leaf_bounds)
        if exact:
            proof = ExactProof(c, source, target, objective.feasible, most, progress)
            attained = proof.check(c)
            report.checks.append(
                "exactly: the leaves are a partition, the claim follows from their bounds, and the "
                "stated parameter attains the upper bound up to rounding"
            )
            lower_bound = _prove(report, proof, c)
            *ends, report.lower_bound, report.upper_bound = interval(c, lower_bound, attained)
        else:
            proof_type = RigidProof if c.model == "rigid3d" else Proof
            lower_bound = _prove(report, proof_type(objective, slack, most, progress), c)
            if slack > NEGLIGIBLE * lower_bound:  # then the proof shows no more
                lower_bound = max(0.0, lower_bound - slack)
            report.lower_bound = lower_bound * area
            ends = [f"{end:.9g}" for end in (report.lower_bound, report.upper_bound)]
    finally:
        report.n_assignments = objective.n_assignments
    _state(report, c, objective.scope, ends, "exactly " * exact)
    report.is_trivial = lower_bound <= 0.0 and c.upper_bound > exact_fit


def _state(report: Report, c: Certificate, scope: str, ends: list[str], how: str) -> None:
    """State what is proven: between which ends the minimum lies."""
    report.checks.append(
        f"on every leaf the objective is at least {ends[0]}, "
        f"proven {how}on {text.count(report.n_boxes, 'box', 'boxes')}"
    )
    among = f" among {len(c.candidates)} candidates" if len(c.candidates) else ""
    report.statement = (
        f"{scope}: the minimum sum of squared residuals over {c.n_inliers} one-to-one "
        f"pairs{among} lies {how}in [{ends[0]}, {ends[1]}]"
    )


def _prove(report: Report, proof: Proof | ExactProof, c: Certificate) -> float:
    """Prove the stated lower bound, or the smaller one that the tolerance permits; return it.

    The search may state a bound that is almost the optimum. If the optimum is attained on a curve or
    surface of poses, as with coincident points, dividing boxes never proves such a bound.
    """
    try:
        proof.run(c, c.lower_bound)
        return c.lower_bound
    except UnprovenError as error:
        permitted = c.upper_bound - c.gap_tol
        if not 0.0 < permitted < c.lower_bound:
            raise
        proof.run(c, permitted)
        report.checks.append(f"{error}; the smaller one that the tolerance permits takes its place")
        return permitted
    finally:
        report.n_boxes = proof.n_boxes


# --- the clouds -----------------------------------------------------------------------------------


def check_clouds(c: Certificate, source: np.ndarray, target: np.ndarray) -> None:
    """Check that the certificate was made for exactly these clouds, with their centres and size."""
    clouds = {"source": source, "target": target}
    for name, points in clouds.items():
        is_same = digest(points) == getattr(c, f"{name}_digest")
        require(is_same, f"{name}: differs from the cloud of the certificate")
        fits = points.ndim == 2 and points.shape[1] == len(c.source_centre)
        require(fits, f"{name}: shape {points.shape} does not fit model {c.model!r}")
    smaller = min(len(source), len(target))
    require(c.n_inliers <= smaller, f"n_inliers: {c.n_inliers} exceeds the smaller cloud")
    # in another unit, the tolerances for rounding would not fit
    unit = _extent(target) or _extent(source) or 1.0
    fits = abs(c.unit - unit) <= 1e-6 * unit
    require(fits, f"unit: {c.unit:.9g} stated, but the clouds measure {unit:.9g}")
    for name, points in clouds.items():
        mean, centre = points.mean(axis=0), getattr(c, f"{name}_centre")
        is_near = np.abs(centre - mean) <= 1e-6 * unit + 1e-12 * np.abs(points).max()
        require(is_near.all(), f"{name}_centre: {centre} stated, but it is {mean}")


def _extent(points: np.ndarray) -> float:
    """Return the RMS distance to the centre; 0 if it is only rounding."""
    extent = float(np.sqrt(points.var(axis=0).sum()))
    return extent if extent > 1e-13 * np.abs(points).max() else 0.0


def objective_of(c: Certificate, source: np.ndarray, target: np.ndarray) -> Objective:
    """Return the objective of the certificate over the normalised clouds."""
    n, m = len(source), len(target)
    is_dense = n * m <= MAX_DENSE
    moving, fixed = (source - c.source_centre) / c.unit, (target - c.target_centre) / c.unit
    pairs = feasible_pairs(c, n, m) if is_dense else None
    if c.model == "rigid3d" and n > m:  # the smaller cloud moves
        moving, fixed = fixed, moving
        pairs = None if pairs is None else pairs.T
    objective = OBJECTIVES[c.model](moving, fixed, c.n_inliers, tuple(c.scale_range), pairs)
    objective.area = c.unit**2
    # free pairs; an infeasible one still costs more
    if pairs is not None and objective.match(np.zeros(pairs.shape)) > 0.0:
        raise CertificateError(f"candidates: fewer than {c.n_inliers} can be matched one-to-one")
    if not is_dense and (len(c.candidates) or not objective.is_sorted_order):
        raise CertificateError(f"cannot be checked: {n} x {m} pairs exceed {MAX_DENSE:,}")
    return objective


def feasible_pairs(c: Certificate, n: int, m: int) -> np.ndarray | None:
    """Return an (n, m) mask of the candidates, None if every pair is feasible."""
    if not len(c.candidates):
        return None
    require((c.candidates < (n, m)).all(), "candidates: an index exceeds the clouds")
    mask = np.zeros((n, m), dtype=bool)
    mask[tuple(c.candidates.T)] = True
    return mask


# --- the values -----------------------------------------------------------------------------------


def check_optimum(objective: Objective, c: Certificate, slack: float) -> None:
    """Check that `theta` is admissible, attains the upper bound, and is not below its leaves' bounds."""
    require(objective.admissible(c.theta[None])[0], "theta: not an admissible parameter")
    value = objective.value(c.theta)
    stated, found = (f"{each * objective.area:.9g}" for each in (c.upper_bound, value))
    require(
        abs(value - c.upper_bound) <= 1e-9 * c.upper_bound + slack,
        f"upper_bound: {stated} stated, but the objective at theta is {found}",
    )
    holds_it = ((c.leaf_lower <= c.theta) & (c.theta <= c.leaf_upper)).all(axis=1)
    around = np.flatnonzero(holds_it)
    # compared by its exact value, which is computed once
    false = around[value < c.leaf_bounds[around] - slack]
    objective.refute(np.tile(c.theta, (len(false), 1)), c.leaf_bounds[false] - slack, false)


def check_samples(objective: Objective, c: Certificate, slack: float, n_samples: int) -> int:
    """Check that no random parameter is below the bound of its leaf; return how many were tried."""
    generator = np.random.default_rng(0)
    leaves = generator.integers(len(c.leaf_bounds), size=n_samples)
    share = generator.random((n_samples, c.leaf_lower.shape[1]))
    thetas = c.leaf_lower[leaves] + share * (c.leaf_upper - c.leaf_lower)[leaves]
    admissible = np.flatnonzero(objective.admissible(thetas))
    # a sum of squares is never below a bound of 0
    tried = admissible[c.leaf_bounds[leaves[admissible]] > slack]
    objective.refute(thetas[tried], c.leaf_bounds[leaves[tried]] - slack, leaves[tried])
    return len(admissible)
