"""The result of a registration: status, pose, bounds, work and the scope of the certificate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dcreg import text
from dcreg.certificate.format import Certificate
from dcreg.certificate.format import write as write_certificate
from dcreg.files import Document, plain
from dcreg.names import MAX_RMS_MET, MAX_RMS_SLACK, NO_PROOF_EXPECTED, WITHIN_TOLERANCE
from dcreg.problem import InputError, OpenDirection, rotation_angle_deg, scale_of
from dcreg.problem.weights import WEIGHTED
from dcreg.result_parts import (
    ChosenNumber,
    MemoryEstimate,
    RunnerUp,
    Sample,
    Score,
    Stage,
    Trace,
)
from dcreg.search import proven_share
from dcreg.status import Status


@dataclass(frozen=True, repr=False)
class Result(Document):
    """The result of `dcreg.register`, in the coordinates and units of the clouds.

    ``print(result)`` shows everything except the pairs.

    Attributes
    ----------
    status : Status
    model, mode, bound : str
        Kind of pose, the mode that ran, and its bounding function.
    T_target_source : (d+1, d+1) array
        Final pose after the polish, as a homogeneous matrix:
        ``p_target = T_target_source @ [p_source, 1]``.
    T_certified : (d+1, d+1) array
        Pose before the polish; it attains `upper_bound`, except in norm space.
    assignment : (n_inliers, 2) int array
        Matched pairs (source row, target row) at `T_target_source`.
    n_inliers : int
    chosen_number : ChosenNumber, optional
        The evidence for `n_inliers`, if the library chose it.
    lower_bound, upper_bound : float
        Bounds on the optimum of the certified objective (see `certificate_scope`), in squared
        units of the target. The objective is a sum over the `n_inliers` pairs.
    gap_tol : float
        The gap that counts as closed at the end: ``max(rel_gap * upper_bound, abs_gap)``, or the upper
        bound of an exact fit.
    is_exact : bool
        Whether the upper bound is 0 up to rounding. The pose is then optimal, whatever the lower bound.
    max_rms : float, optional
        The requested residual, as in `dcreg.register`.
    certificate_scope : str
        What the bounds refer to: ``"similarity pose"``, ``"translation in norm space"``, ...
        It contains ``"of the sample"`` if they hold for the sample only.
    objective : float
        Sum of squared residuals of the `n_inliers` matched pairs at `T_target_source`; with weights of
        points, the sum of the costs of `PointWeights`; with attributes, of `Attributes`.
    attribute_cost : float, optional
        The part of `objective` that `Attributes` cause, if they are given.
    objective_certified : float
        The same sum at `T_certified`, before the polish.
    n_nodes, n_assignments : int
        Boxes bounded and exact assignments solved in all stages except the polish. Unless elapsed time
        ends a step (the time limit or the time for a proof), both are independent of threads and load,
        and equal on machines whose floating-point results are equal.
    time_setup_s, time_solve_s : float
        Wall time of the preparation (validation, normalisation, JIT warm-up) and of the solve.
    time_earlier_s : float
        The part of `time_solve_s`, and of the times of stages and events, that earlier calls with the
        same checkpoint took; 0 without a checkpoint.
    trace : Trace
        Bound history.
    stages : list of Stage
        In the order in which they ran.
    certificate : Certificate, optional
        The leaf boxes of the search, if requested.
    downsampled : Sample, optional
        Sizes of the sample that was searched, if it was not the full clouds. Then bounds, `gap_tol` and
        `T_certified` refer to the sample; final pose, pairs and objectives refer to all points. None if
        an exact fit of all points is proven instead.
    score : Score, optional
        Score over the matches, from `dcreg.register_matches`.
    runner_up : RunnerUp, optional
        The best pose found that clearly differs from this one.
    covariance : (6, 6) array in 3D, (7, 7) with a free scale, (4, 4) array in 2D, optional
        Covariance of ``xi`` in ``T_target_source @ Exp(xi)``, with rotation (radians) first, then
        translation, then the logarithm of the scale (in 2D zeros if it is fixed). It follows from the
        residuals of the pairs and assumes that the pairs are right, with independent and equally large
        errors. It is far too small for scans of a surface at different points, and too small if fewer
        pairs than true ones are matched. None if the pairs do not determine the pose, or if it lies
        at a limit of its range.
    open_directions : list of OpenDirection, optional
        Motions along which the clouds slide on each other, such as those of a plane. Other pairs then fit
        as well, so the covariance does not show these motions. Empty with fewer than 10 points. None,
        which means not tested, with a range of poses.
    memory_estimate : MemoryEstimate, optional
        The memory that the solve was expected to need.
    warnings : list of str
        Possible problems with the result, and what to do about them.
    """

    status: Status
    model: str
    mode: str
    bound: str
    T_target_source: np.ndarray
    T_certified: np.ndarray
    assignment: np.ndarray
    n_inliers: int
    lower_bound: float
    upper_bound: float
    gap_tol: float
    is_exact: bool
    certificate_scope: str
    objective: float
    objective_certified: float
    n_nodes: int
    n_assignments: int
    time_setup_s: float
    time_solve_s: float
    trace: Trace
    stages: list[Stage] = field(default_factory=list)
    certificate: Certificate | None = None
    downsampled: Sample | None = None
    score: Score | None = None
    runner_up: RunnerUp | None = None
    max_rms: float | None = None
    chosen_number: ChosenNumber | None = None
    covariance: np.ndarray | None = None
    open_directions: list[OpenDirection] | None = None
    memory_estimate: MemoryEstimate | None = None
    time_earlier_s: float = 0.0
    attribute_cost: float | None = None
    warnings: list[str] = field(default_factory=list)

    @property
    def gap(self) -> float:
        """Absolute gap ``upper_bound - lower_bound``, never negative."""
        return max(0.0, self.upper_bound - self.lower_bound)

    @property
    def bound_ratio(self) -> float:
        """Lower bound divided by upper bound (L/U); 1 for an exact fit."""
        return 1.0 if self.is_exact else proven_share(self.lower_bound, self.upper_bound)

    @property
    def gap_closed(self) -> bool:
        """Whether the gap is closed by bounds that prove it, even if a later stage did not finish."""
        return self.is_exact or (self.lower_bound > 0.0 and self.gap <= self.gap_tol)

    @property
    def reason(self) -> str:
        """Why the status is ``converged``; empty for another status."""
        if self.status is not Status.CONVERGED:
            return ""
        if self.max_rms is not None and not self._misses_max_rms:
            return MAX_RMS_MET
        # no tolerance decides about `max_rms`
        if self.max_rms is None and self.gap <= self.gap_tol:
            return "a later stage is not certified" if self.gap_closed else WITHIN_TOLERANCE
        gave_up = any(stage.status is Status.CONVERGED for stage in self.stages)
        return NO_PROOF_EXPECTED if gave_up else "method's own end"

    @property
    def _misses_max_rms(self) -> bool:
        """Whether the residual of the pairs exceeds `max_rms` by more than rounding."""
        return self.max_rms is not None and self.rmse_matched > self.max_rms * (1.0 + MAX_RMS_SLACK)

    @property
    def n_bounded(self) -> int:
        """Number of pairs that the bounds refer to: `n_inliers` of the clouds or of the sample."""
        return self.n_inliers if self.downsampled is None else self.downsampled.n_inliers

    @property
    def is_greedy(self) -> bool:
        """Whether pairs were chosen greedily because the time limit was hit."""
        return any(stage.greedy_assignment for stage in self.stages)

    @property
    def success(self) -> bool:
        """Whether the status is ``optimal``: bounds that prove the optimum close the gap.

        It does not say whether the pose is the true one.
        """
        return self.status is Status.OPTIMAL

    @property
    def scale(self) -> float:
        """Scale of the final pose; 1 for ``rigid3d``."""
        return scale_of(self.T_target_source)

    @property
    def rotation(self) -> np.ndarray:
        """(d, d) rotation matrix of the final pose."""
        return self.T_target_source[:-1, :-1] / self.scale

    @property
    def translation(self) -> np.ndarray:
        """(d,) translation of the final pose, in units of the target."""
        return self.T_target_source[:-1, -1]

    @property
    def rotation_deg(self) -> float:
        """Angle of the rotation in degrees: signed in 2D, about the axis in 3D."""
        return rotation_angle_deg(self.rotation)

    @property
    def rmse_matched(self) -> float:
        """Root mean square residual of the matched pairs, in units of the target; NaN without pairs.

        Attributes do not count: it is the square root of ``(objective - attribute_cost) / n_inliers``.
        """
        residuals = max(0.0, self.objective - (self.attribute_cost or 0.0))
        return float(np.sqrt(residuals / self.n_inliers)) if self.n_inliers else np.nan

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; an infinite bound becomes None. The manual lists all keys."""
        names = (
            "status", "reason", "T_target_source", "T_certified", "scale", "model", "n_inliers",
            "chosen_number", "bound", "mode", "lower_bound", "upper_bound", "gap", "gap_tol",
            "bound_ratio", "is_exact", "objective", "objective_certified", "attribute_cost",
            "n_nodes", "n_assignments", "time_setup_s",
            "time_solve_s", "time_earlier_s", "certificate_scope", "rmse_matched", "max_rms",
            "assignment", "downsampled", "score", "runner_up", "covariance", "open_directions",
            "memory_estimate", "warnings",
        )  # fmt: skip
        values = {name: getattr(self, name) for name in names}
        return plain({**values, "stages": [stage.to_dict() for stage in self.stages]})

    def write_certificate(self, path: str | Path) -> None:
        """Write the leaf boxes to an .npz file, which `dcreg.verify` checks.

        Raises
        ------
        InputError
            If the result has no certificate.
        """
        if self.certificate is None:
            raise InputError(
                "certificate: the result has none; register with SolveOptions(certificate=True)"
            )
        write_certificate(path, self.certificate)

    def summary(self) -> str:
        """Return everything except the pairs as lines of plain text."""
        return text.listing(list(self.entries()))

    __str__ = summary

    def __repr__(self) -> str:
        pairs = text.count(self.n_inliers, "pair")
        return (
            f"<Result {self.status.value}: {self.model}, mode {self.mode}, {pairs}, "
            f"bounds [{self.lower_bound:.6g}, {self.upper_bound:.6g}], RMSE {self.rmse_matched:.4g}>"
        )

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield names and values of the `summary`; every warning is an entry of that name."""
        scope = self.certificate_scope
        yield "status", self._verdict(scope)
        if self._misses_max_rms and self.status is not Status.REFUTED:
            yield (
                "answer",
                f"open: no pose was found that matches {text.count(self.n_inliers, 'pair')} with an RMS "
                f"residual of at most {self.max_rms:.12g}, and it is not proven that there is none",
            )
        yield "T_target_source", text.pose(self.T_target_source)
        yield "scale", f"{self.scale:.6g}"
        yield "rotation", f"{self.rotation_deg:.4f} deg"
        # the square root of the mean cost, if points have weights
        rms = "RMS cost" if WEIGHTED in scope else "RMSE of pairs"
        yield rms, f"{self.rmse_matched:.6g} over {text.count(self.n_inliers, 'pair')}"
        if self.chosen_number is not None:
            yield (
                "number of pairs",
                f"{self.n_inliers}, chosen by the library; {self.chosen_number}",
            )
        if self.score is not None:
            yield (
                "score",
                f"{self.score.reached:.5g}; proven: no pose scores above {self.score.upper_bound:.5g} "
                "(a match counts 1 - (residual / inlier distance)^2)",
            )
        yield "lower bound", f"{self.lower_bound:.6g}"
        yield "upper bound", f"{self.upper_bound:.6g}"
        yield "gap", f"{self.gap:.4g} (tolerance {self.gap_tol:.4g}); {self._ratio_in_words()}"
        yield "scope of bounds", scope
        bounding = [stage for stage in self.stages if stage.status is not None]
        for stage in bounding if len(bounding) > 1 else []:
            yield f"{stage.name} stage", stage.summary()
        confining = [stage for stage in self.stages if stage.outside is not None]
        for stage in confining[-1:]:
            yield f"{stage.name} stage", stage.confinement()
        before = self.objective_certified
        yield "objective", f"{self.objective:.6g} (before the polish {before:.6g})"
        if self.attribute_cost is not None:
            yield "attribute cost", f"{self.attribute_cost:.6g} of the objective"
        assignments = text.count(self.n_assignments, "assignment")
        yield "work", f"{text.count(self.n_nodes, 'node')}, {assignments}"
        preparation = f"{self.time_setup_s:.2f} s for the preparation"
        earlier = ""
        if self.time_earlier_s:
            own_s = self.time_solve_s - self.time_earlier_s
            earlier = f" in all calls ({own_s:.2f} s in this one)"
        yield "time", f"{self.time_solve_s:.2f} s for the solve{earlier}, {preparation}"
        yield "method", f"{self.model}, mode {self.mode}, bound {self.bound}"
        if self.downsampled is not None:
            sample = self.downsampled
            yield (
                "downsampled",
                f"the bounds refer to {text.count(sample.n_inliers, 'pair')} among {sample.n_source} "
                f"source and {sample.n_target} target points; the pose is refined on all points",
            )
        if self.covariance is not None:
            yield "uncertainty", self._deviations(self.covariance)
        if self.open_directions:
            n = len(self.open_directions)
            yield "open directions", f"{n}; the standard deviations do not show them"
        if self.score is None:
            yield "runner-up pose", "not known" if self.runner_up is None else str(self.runner_up)
        for warning in self.warnings:
            yield "warning", warning

    def _verdict(self, scope: str) -> str:
        status = self.status
        if status is Status.OPTIMAL:
            return f"optimal: certified for the {scope}; {self._ratio_in_words()}"
        if status is Status.REFUTED and self.max_rms is not None:
            rms = float(np.sqrt(self.lower_bound / self.n_inliers))
            return (
                f"refuted: no {scope} matches {text.count(self.n_inliers, 'pair')} with an RMS residual "
                f"of at most {self.max_rms:.12g}; proven: it is at least {_above(rms, self.max_rms)}"
            )
        is_certified = self.gap_closed and not self._misses_max_rms
        if status is not Status.CONVERGED:
            later = f"; certified for the {scope}, but a later stage did not finish"
            return f"{status.value}: best pose so far{later if is_certified else ', not certified'}"
        certified = f"certified for the {scope}" if is_certified else "not certified"
        goes_on = self.reason == NO_PROOF_EXPECTED and not (self.downsampled or self.score)
        remedy = "; prove=True (--prove) searches longer" if goes_on else ""
        return f"converged: {self.reason}; {certified}{remedy}"

    def _deviations(self, covariance: np.ndarray) -> str:
        """Return the standard deviations of a small motion, in words."""
        deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        n = 3 if len(covariance) > 4 else 1
        rotation, shift, growth = np.split(deviations, [n, n + len(self.translation)])
        parts = {
            "rotation": (np.degrees(rotation), " deg"),
            "translation": (shift, ""),
            "scale": (100.0 * growth[growth > 0.0], " %"),
        }
        words = [
            f"{name} {' '.join(f'{x:.3g}' for x in values)}{unit}"
            for name, (values, unit) in parts.items()
            if len(values)
        ]
        return f"standard deviations if the pairs are right: {', '.join(words)} (in source coordinates)"

    def _ratio_in_words(self) -> str:
        """Return the lower bound as a share of the upper bound, in words."""
        if self.is_exact:
            return "the fit is exact up to rounding"
        return f"the lower bound is {text.percent(self.bound_ratio)} of the upper bound"


def with_answer(result: Result) -> Result:
    """Return a result for `max_rms` as converged if its pose meets it, even if a limit was hit."""
    is_met_at_limit = result.status.is_limit and not result._misses_max_rms
    return replace(result, status=Status.CONVERGED) if is_met_at_limit else result


def _above(value: float, limit: float) -> str:
    """Return a lower bound above a limit, rounded down, with enough digits to show it."""
    texts = (text.rounded_down(value, digits) for digits in range(4, 17))
    return next((shown for shown in texts if float(shown) > limit), f"{value!r}")
