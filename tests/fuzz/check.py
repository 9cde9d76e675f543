"""Is what the library claims of a problem true? Checked against `tests.fuzz.reference`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import dcreg
from dcreg.result import Result
from dcreg.status import Status
from tests.fuzz import reference
from tests.fuzz.problems import FuzzProblem

MAX_CUBES = 300_000


@dataclass(frozen=True)
class Verdict:
    """``lower <= optimum <= upper`` by the reference; `faults` are the claims that are wrong."""

    lower: float
    upper: float
    closed: bool  # the reference is exact, or its enclosure as narrow as asked for
    faults: list[str]


def check(problem: FuzzProblem, result: Result) -> Verdict:
    """Compare bounds, pose and status of `result` with the true optimum of `problem`."""
    lower, upper, closed = optimum(problem, result.gap_tol)
    slack = _slack(problem)
    faults = []
    if result.lower_bound > upper + slack:
        faults.append(f"lower bound {result.lower_bound:.9g} above the optimum {upper:.9g}")
    if result.upper_bound < lower - slack:
        faults.append(f"upper bound {result.upper_bound:.9g} below the optimum {lower:.9g}")
    if result.status is Status.OPTIMAL:
        if result.upper_bound - upper > result.gap_tol + slack:
            faults.append(
                f"optimal within {result.gap_tol:.9g} claimed for {result.upper_bound:.9g}, "
                f"the optimum is {upper:.9g}"
            )
        if result.upper_bound - result.lower_bound > result.gap_tol + slack:
            faults.append("optimal claimed with an open gap")
        if result.lower_bound <= 0.0 and not result.is_exact:
            faults.append("optimal claimed with a lower bound of 0")
    attained = certified_value(problem, result.T_certified)
    if abs(attained - result.upper_bound) > slack:
        faults.append(f"upper bound {result.upper_bound:.9g}, but its pose has {attained:.9g}")
    faults += _pose_faults(problem, result, slack)
    if result.certificate is not None:
        report = dcreg.verify(result.certificate, problem.source, problem.target)
        if not report.accepted:
            faults.append(f"certificate refused: {report.reason}")
    return Verdict(lower, upper, closed, faults)


def optimum(problem: FuzzProblem, gap_tol: float) -> tuple[float, float, bool]:
    """Enclosure of the optimum, and whether it is as narrow as it should be."""
    source, target, k = problem.source, problem.target, problem.n_inliers
    allowed = problem.allowed
    if problem.family != "norm3d":
        source, target = (points - points.mean(axis=0) for points in (source, target))
        value = reference.optimum(source, target, allowed, k, *problem.scale_range)
        return value, value, True
    x, norms, allowed = _norm_space(problem)
    lower, upper = reference.enclose_norm3d(x, norms, allowed, k, 0.5 * gap_tol, MAX_CUBES)
    return lower, upper, upper - lower <= gap_tol


def certified_value(problem: FuzzProblem, T: np.ndarray) -> float:
    """The certified objective at a pose."""
    source, target, k = problem.source, problem.target, problem.n_inliers
    allowed = problem.allowed
    if problem.family != "norm3d":
        d = source.shape[1]
        return reference.objective(source @ T[:d, :d].T + T[:d, d], target, allowed, k)
    x, norms, allowed = _norm_space(problem)
    t = T[:3, :3].T @ (T[:3, 3] - target.mean(axis=0)) + source.mean(axis=0)
    return reference.norm_objective(x, norms, allowed, k, t)


def _norm_space(problem: FuzzProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What mode `paper` searches: source about its centroid, ascending norms of the target about its.

    With them the allowed pairs, their columns in the same order.
    """
    centred = problem.target - problem.target.mean(axis=0)
    norms = np.linalg.norm(centred, axis=1)
    order = np.argsort(norms)
    return problem.source - problem.source.mean(axis=0), norms[order], problem.allowed[:, order]


def _slack(problem: FuzzProblem) -> float:
    """What rounding may change an objective by: relative to the extent, and to the coordinates."""
    clouds = (problem.source, problem.target)
    extent = sum(((points - points.mean(axis=0)) ** 2).sum(axis=1).max() for points in clouds)
    place = max(np.abs(points).max() for points in clouds)
    return float(problem.n_inliers * (1e-8 * extent + (1e-9 * place) ** 2))


def _pose_faults(problem: FuzzProblem, result: Result, slack: float) -> list[str]:
    faults = []
    d = problem.source.shape[1]
    low, high = problem.scale_range
    for name, T in (
        ("T_certified", result.T_certified),
        ("T_target_source", result.T_target_source),
    ):
        scale = np.linalg.det(T[:d, :d]) ** (1 / d)
        if not low - 1e-9 <= scale <= high + 1e-9:
            faults.append(f"{name}: scale {scale:.9g} outside [{low}, {high}]")
        elif not np.allclose(T[:d, :d].T @ T[:d, :d], scale**2 * np.eye(d), atol=1e-9):
            faults.append(f"{name}: not a similarity")
    moved = problem.source @ result.T_target_source[:d, :d].T + result.T_target_source[:d, d]
    value = reference.objective(moved, problem.target, problem.allowed, problem.n_inliers)
    if abs(value - result.objective) > slack:
        faults.append(f"objective {result.objective:.9g} stated, {value:.9g} found")
    i, j = result.assignment.T
    stated = float(((moved[i] - problem.target[j]) ** 2).sum())
    if len(set(i)) != problem.n_inliers or len(set(j)) != problem.n_inliers:
        faults.append("assignment is not one to one")
    elif abs(stated - result.objective) > slack:
        faults.append(f"objective {result.objective:.9g} stated, its pairs give {stated:.9g}")
    return faults
