"""Is this pose right? The objective of a pose from any program, and how much better a pose can be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dcreg import text
from dcreg.answer import Answer
from dcreg.assignment.objective import constant_cost, is_large, objective, weighted_objective
from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.solve import exact_value, register_problem
from dcreg.files import plain
from dcreg.names import DEFAULT_REL_GAP, DEFAULT_TIME_LIMIT_S
from dcreg.problem import (
    Candidates,
    InputError,
    Moments,
    PointWeights,
    PoseRange,
    Problem,
    angle_between_deg,
    checked_pose,
    rounding_error,
    scale_of,
)
from dcreg.problem.weights import WEIGHTED
from dcreg.result import Result

if TYPE_CHECKING:
    from dcreg.problem.attributes import Attributes

# Verdicts on a pose.
OPTIMAL, IMPROVABLE, OPEN = "optimal", "improvable", "open"
_ROUNDING = 1e-6  # relative
_DIGITS = 1e-4  # relative; deviations of a printed pose that count as rounding
_NOTABLE = 0.1  # share of the tolerance by which a better pose has to be better


@dataclass(frozen=True, repr=False)
class Certified(Answer):
    """What is known about a given pose; see `dcreg.certify`.

    Attributes
    ----------
    verdict : str
        ``optimal``: proven up to the tolerance, by a lower bound above `constant_cost` or an exact fit.
        ``improvable``: the pose of `result` is better by more than a tenth of the tolerance. ``open``:
        neither.
    T_target_source : (d+1, d+1) array
        The given pose; if its last digits make it inadmissible, the nearest admissible one.
    objective : float
        The minimum sum of squared residuals of `n_inliers` one-to-one pairs at this pose, in squared
        units of the target; with weights or attributes, the minimum sum of the costs of pairs.
    lower_bound : float
        No pose has a lower objective.
    gap_tol : float
        The gap that counts as closed.
    is_exact : bool
        The objective is 0 up to rounding.
    displacement : float
        RMS displacement of the source points between the given pose and that of `result`.
    angle_deg : float
        Angle of the rotation between them.
    result : Result
        The result of the search, which started from the given pose.
    constant_cost : float
        The minimum over all matchings of what weights and attributes cost at every pose; 0 without them.
    """

    verdict: str
    T_target_source: np.ndarray
    objective: float
    lower_bound: float
    gap_tol: float
    is_exact: bool
    displacement: float
    angle_deg: float
    result: Result
    constant_cost: float = 0.0

    question = "given pose"

    @property
    def warnings(self) -> list[str]:
        """The warnings of the search."""
        return self.result.warnings

    @property
    def poses(self) -> dict[str, np.ndarray]:
        """The given pose and that of the search."""
        return {"given pose": self.T_target_source, self._found: self.result.T_target_source}

    @property
    def _found(self) -> str:
        """Name of the pose of the search, which is worse if a limit ends its refinement."""
        is_worse = self.result.objective > self.objective * (1.0 + _ROUNDING)
        return "pose found" if is_worse else "best known pose"

    @property
    def max_improvement(self) -> float:
        """The most by which any pose can lower the objective."""
        return max(0.0, self.objective - self.lower_bound)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = (
            "verdict", "T_target_source", "objective", "lower_bound", "max_improvement", "gap_tol",
            "is_exact", "displacement", "angle_deg", "constant_cost",
        )  # fmt: skip
        values = {name: getattr(self, name) for name in names}
        return plain({**values, "result": self.result.to_dict()})

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield names and values of the summary."""
        k = self.result.n_inliers
        yield "given pose", self.answer
        pairs, rms = text.count(k, "pair"), np.sqrt(self.objective / k)
        # with attributes or weighted points, the objective is not the sum of squared residuals
        is_plain = (
            self.result.attribute_cost is None and WEIGHTED not in self.result.certificate_scope
        )
        about = f"RMS residual {rms:.6g} over " if is_plain else ""
        yield "objective", f"{self.objective:.6g} ({about}{pairs})"
        share = self.max_improvement / self.objective if self.objective > 0.0 else 0.0
        meaning = f"no pose lowers the objective by more than {_percent_above(share)}"
        if self.is_exact:
            meaning = "the fit is exact up to rounding"
        elif share == 1.0 and self.result.is_exact and self.result.objective < self.objective:
            meaning = "the best known pose is an exact fit"
        elif share == 1.0:
            meaning = "nothing is proven, because every sum of squares is at least 0"
        elif self.verdict != OPTIMAL and _is_trivial(self.lower_bound, self.constant_cost):
            meaning = (
                "nothing is proven about residuals, because weights and attributes alone cost as much; a "
                "smaller rel_gap (--rel-gap) may prove more"
            )
        yield "lower bound", f"{self.lower_bound:.6g}: {meaning}"
        if self.verdict != OPTIMAL:
            yield (
                self._found,
                f"objective {self.result.objective:.6g}; differs from the given pose by "
                f"{self.displacement:.4g} (RMS displacement) and {self.angle_deg:.4g} deg",
            )
        yield "search", self.result.summary()

    @property
    def answer(self) -> str:
        """The verdict in a sentence."""
        if self.verdict == OPTIMAL:
            return "optimal up to the tolerance: proven"
        if self.verdict == IMPROVABLE:
            return "improvable: a pose with a lower objective is known"
        return "open: neither proven optimal nor improved"


def certify(
    source: np.ndarray,
    target: np.ndarray,
    pose: np.ndarray,
    *,
    n_inliers: int | float,
    model: str,
    scale_range: tuple[float, float] | None = None,
    candidates: Candidates | None = None,
    pose_range: PoseRange | None = None,
    weights: PointWeights | None = None,
    attributes: Attributes | None = None,
    rel_gap: float = DEFAULT_REL_GAP,
    abs_gap: float | None = None,
    tol: float | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    node_limit: int | None = None,
    memory_limit_mb: float | None = None,
    options: SolveOptions | None = None,
) -> Certified:
    """Judge a pose from any program: is it optimal, and how much better can another pose be?

    Parameters
    ----------
    source, target, n_inliers, model, scale_range, candidates, pose_range, weights, attributes
        As in `dcreg.register`.
    pose : (d+1, d+1) array
        From source to target.
    rel_gap, abs_gap, tol, time_limit, node_limit, memory_limit_mb
        As in `dcreg.register`.
    options : SolveOptions, optional
        As in `dcreg.register`, without `init`.

    Returns
    -------
    Certified

    Raises
    ------
    InputError
        For bad input, before any search.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((20, 2))
    >>> pose = np.eye(3)
    >>> pose[:2, 2] = 3.0, 3.0
    >>> dcreg.certify(points, points + 3.0, pose, n_inliers=20, model="similarity2d").verdict
    'optimal'
    """
    given = model, scale_range, candidates, pose_range, weights
    problem = Problem(source, target, n_inliers, *given).with_attributes(attributes)
    chosen = SolveOptions.of(options)
    if chosen.init is not None:
        raise InputError(
            "init: certify begins with the pose that it judges; omit init, or give a range of poses "
            "around it (PoseRange(around=...), or --init with --max-angle)"
        )
    T = _admissible(checked_pose("pose", pose, problem.dim, has_scale=problem.has_scale), problem)
    limits = Limits(rel_gap, abs_gap, tol, time_limit, node_limit, memory_limit_mb)
    value = _objective(problem, T)
    result = register_problem(problem, limits, replace(chosen, init=T))
    return _judged(problem, T, value, result, limits)


def _objective(problem: Problem, T: np.ndarray) -> float:
    """Return the cost of the cheapest pairs at a pose."""
    if problem.weights is not None:
        return weighted_objective(problem, T)[0]
    clouds, k = (problem.source, problem.target), problem.n_inliers
    is_small = not is_large(*map(len, clouds))
    return objective(*clouds, T, k, problem.candidates, prove=is_small)[0]


def _admissible(T: np.ndarray, problem: Problem) -> np.ndarray:
    """Return the pose, without the rounding of its digits if that makes it inadmissible.

    Raises
    ------
    InputError
        If it differs from all admissible poses by more than rounding.
    """
    low, high = problem.scale_range
    scale, d = scale_of(T), problem.dim
    clipped = min(max(scale, low), high)
    if abs(clipped - scale) > _DIGITS * scale:
        raise InputError(
            f"pose: its scale {scale:.6g} is outside scale_range ({low:g}, {high:g}); give a larger range"
        )
    T = T.copy()
    T[:d, :d] *= clipped / scale
    if problem.pose_range is None or problem.pose_range.contains(T):
        return T
    nearest = problem.pose_range.nearest(T)
    if np.abs(nearest - T).max() > _DIGITS * np.abs(T).max():
        raise InputError("pose: not admitted by pose_range; give a larger range, or another pose")
    return nearest


def _percent_above(share: float) -> str:
    """Return a share in per cent, rounded up."""
    return f"{math.ceil(1000.0 * share - 1e-6) / 10.0:.1f} %"


def _is_trivial(lower_bound: float, constant: float) -> bool:
    """Whether a lower bound holds for all residuals, because it is at most the constant cost."""
    return lower_bound <= constant * (1.0 + _ROUNDING)


def _judged(
    problem: Problem, T: np.ndarray, value: float, result: Result, limits: Limits
) -> Certified:
    source, target, k = problem.source, problem.target, problem.n_inliers
    best = result.T_target_source
    # the bounds of a sample do not refer to all points
    lower_bound = 0.0 if result.downsampled is not None else min(result.lower_bound, value)
    exact = exact_value(problem)
    allowed = limits.tolerance(k, rounding_error(source, target, k), exact).allowed(value)
    verdict, constant = OPEN, constant_cost(problem)
    is_exact = bool(value - constant <= exact + _ROUNDING**2 * constant)
    proves = is_exact or not _is_trivial(lower_bound, constant)
    displacement = Moments.of(source).displacement(best, T)
    if proves and value - lower_bound <= allowed * (1.0 + _ROUNDING):
        verdict = OPTIMAL
    elif result.objective < value - _NOTABLE * allowed:
        verdict = IMPROVABLE
    return Certified(
        verdict, T, value, lower_bound, allowed, is_exact, displacement, angle_between_deg(best, T),
        result, constant,
    )  # fmt: skip
