"""What a registration returns: status, pose, bounds, work and the scope of the certificate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dcreg import text
from dcreg._version import __version__
from dcreg.certificate.format import Certificate
from dcreg.certificate.format import write as write_certificate
from dcreg.files import as_json, write_text
from dcreg.problem import InputError, rotation_angle_deg, scale_of
from dcreg.runner_up import Rival
from dcreg.search import Outcome, Trace
from dcreg.status import Status


@dataclass(frozen=True)
class Stage:
    """One stage of a solve, with its own bounds, work and time.

    Attributes
    ----------
    name : str
        ``search``, ``rotation``, ``rigid`` or ``polish``; of mode ``multi`` also ``start``, ``basins``
        and ``basin 3 of 12``, of a sweep ``descents``.
    time_s : float
    n_nodes, n_assignments : int
    status : Status, optional
        How it ended; None where a stage has no bounds of its own.
    lower_bound, upper_bound : float, optional
        Of what this stage minimises.
    gap_tol : float, optional
        The gap asked of this stage, where it is not the one asked of the solve.
    objective_before, objective_after : float, optional
        Of the polish: sum of squared residuals of the matched pairs.
    hurried : bool, optional
        True where the time was over before the pairs were matched: near ones were taken.
    """

    name: str
    time_s: float
    n_nodes: int = 0
    n_assignments: int = 0
    status: Status | None = None
    lower_bound: float | None = None
    upper_bound: float | None = None
    gap_tol: float | None = None
    objective_before: float | None = None
    objective_after: float | None = None
    hurried: bool | None = None

    @classmethod
    def of(cls, name: str, found: Outcome, gap_tol: float | None = None) -> Stage:
        """The account of one search."""
        return cls(
            name,
            found.time_s,
            found.n_nodes,
            found.n_assignments,
            found.status,
            found.lower_bound,
            found.upper_bound,
            gap_tol,
        )

    def scaled(self, factor: float) -> Stage:
        """The same stage with its bounds in other units."""

        names = ("lower_bound", "upper_bound", "gap_tol")
        present = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(self, **{name: factor * value for name, value in present.items()})

    def summary(self) -> str:
        """One line of a stage that has bounds."""
        return (
            f"{self.status}, bounds [{self.lower_bound:.5g}, {self.upper_bound:.5g}], "
            f"{text.count(self.n_nodes, 'node')}, {self.time_s:.2f} s"
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; what a stage does not have is left out."""
        values = {"stage": self.name, **asdict(self)}
        del values["name"]
        if self.status is not None:
            values["status"] = self.status.value
        return {key: value for key, value in values.items() if value is not None}


@dataclass(frozen=True, repr=False)
class Result:
    """The outcome of `dcreg.register`, in the coordinates and units of the clouds.

    ``print(result)`` shows all but the pairs.

    Attributes
    ----------
    status : Status
    model, mode, bound : str
        What was solved, the mode that ran, and its lower bounding function.
    T_target_source : (d+1, d+1) array
        Homogeneous pose: ``p_target = T_target_source @ [p_source, 1]``; the final, polished pose.
    T_certified : (d+1, d+1) array
        The pose before the joint polish; in 2D it attains `upper_bound`.
    assignment : (n_inliers, 2) int array
        Matched pairs (source row, target row) at `T_target_source`.
    n_inliers : int
    lower_bound, upper_bound : float
        Bounds on the optimum of the certified objective (see `certificate_scope`), in squared
        units of the target. The objective is a sum over the `n_inliers` pairs.
    gap_tol : float
        Absolute tolerance on ``upper_bound - lower_bound``.
    certificate_scope : str
        What the bounds speak of: ``"similarity pose"``, ``"translation in norm space"``, ...
    objective : float
        Sum of squared residuals of the `n_inliers` matched pairs at `T_target_source`.
    objective_certified : float
        The same sum at `T_certified`, so that the polish is reported apart.
    n_nodes, n_assignments : int
        Boxes bounded and exact assignments solved, in all stages but the polish: independent of threads
        and load, and the same wherever floating-point results are.
    time_setup_s, time_solve_s : float
        Wall time for preparing (validation, normalisation, JIT warm-up) and for solving.
    trace : Trace
        Bound history.
    stages : list of Stage
        In the order in which they ran.
    certificate : Certificate, optional
        The leaf boxes of the search, when asked for.
    downsampled : (int, int, int), optional
        Source points, target points and pairs that were searched, where they are not all: bounds,
        `gap_tol` and `T_certified` are of these; final pose, pairs and objectives of all points.
    score : (float, float), optional
        Of `dcreg.register_matches`: the chosen matches, each counted as 1 less its squared residual in
        squared inlier distances, and the most that any pose can score, as far as is proven.
    rival : Rival, optional
        The best pose met that differs from this one, with its share of the objective.
    warnings : list of str
        What should not be trusted without a second look, each with its remedy.
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
    downsampled: tuple[int, int, int] | None = None
    score: tuple[float, float] | None = None
    rival: Rival | None = None
    warnings: list[str] = field(default_factory=list)

    @property
    def gap(self) -> float:
        """Absolute gap ``upper_bound - lower_bound``, never negative."""
        return max(0.0, self.upper_bound - self.lower_bound)

    @property
    def n_bounded(self) -> int:
        """Pairs that the bounds speak of: `n_inliers`, or those of the sample that was searched."""
        return self.n_inliers if self.downsampled is None else self.downsampled[2]

    @property
    def is_hurried(self) -> bool:
        """Whether the time was over before the pairs were matched, so that near ones were taken."""
        return any(stage.hurried for stage in self.stages)

    @property
    def success(self) -> bool:
        """Whether the bounds closed: status ``optimal``."""
        return self.status is Status.OPTIMAL

    @property
    def scale(self) -> float:
        """Scale of the final pose; 1 in 3D."""
        return scale_of(self.T_target_source)

    @property
    def rotation(self) -> np.ndarray:
        """(d, d) rotation matrix of the final pose."""
        d = self.T_target_source.shape[0] - 1
        return self.T_target_source[:d, :d] / self.scale

    @property
    def translation(self) -> np.ndarray:
        """(d,) translation of the final pose, in units of the target."""
        d = self.T_target_source.shape[0] - 1
        return self.T_target_source[:d, d]

    @property
    def rotation_deg(self) -> float:
        """Angle of the rotation in degrees: signed in 2D, about the axis in 3D."""
        return rotation_angle_deg(self.rotation)

    @property
    def rmse_matched(self) -> float:
        """Root mean square residual of the matched pairs, in units of the target."""
        return float(np.sqrt(self.objective / self.n_inliers))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; every key is documented in the manual."""
        return {
            "status": self.status.value,
            "T_target_source": self.T_target_source.tolist(),
            "T_certified": self.T_certified.tolist(),
            "scale": self.scale,
            "model": self.model,
            "n_inliers": self.n_inliers,
            "bound": self.bound,
            "mode": self.mode,
            "lower_bound": self.lower_bound,
            "upper_bound": self.upper_bound,
            "gap": self.gap,
            "gap_tol": self.gap_tol,
            "objective": self.objective,
            "objective_certified": self.objective_certified,
            "n_nodes": self.n_nodes,
            "n_assignments": self.n_assignments,
            "time_setup_s": self.time_setup_s,
            "time_solve_s": self.time_solve_s,
            "certificate_scope": self.certificate_scope,
            "rmse_matched": self.rmse_matched,
            "assignment": self.assignment.tolist(),
            "downsampled": None if self.downsampled is None else list(self.downsampled),
            "score": None if self.score is None else list(self.score),
            "rival": None if self.rival is None else self.rival.to_dict(),
            "warnings": list(self.warnings),
            "stages": [stage.to_dict() for stage in self.stages],
        }

    def to_json(self, **more: Any) -> str:
        """`to_dict` and the version as JSON, with `more` keys (such as names of files).

        An infinite bound becomes null.
        """
        return as_json({**self.to_dict(), **more, "dcreg_version": __version__})

    def write_json(self, path: str | Path, **more: Any) -> None:
        """Write `to_json` to a file."""
        write_text(path, self.to_json(**more) + "\n")

    def write_certificate(self, path: str | Path) -> None:
        """Write the leaf boxes to an .npz file, which `dcreg.verify` checks.

        Raises
        ------
        InputError
            If the boxes were not kept.
        """
        if self.certificate is None:
            raise InputError("certificate: none was kept; call register with certificate=True")
        write_certificate(path, self.certificate)

    def summary(self) -> str:
        """Everything but the pairs, in lines of plain text."""
        return text.listing(list(self.entries()))

    __str__ = summary

    def __repr__(self) -> str:
        return (
            f"<Result {self.status.value}: {self.model}, mode {self.mode}, {self.n_inliers} pairs, "
            f"bounds [{self.lower_bound:.6g}, {self.upper_bound:.6g}], RMSE {self.rmse_matched:.4g}>"
        )

    def entries(self) -> Iterator[tuple[str, str]]:
        """Names and values of the `summary`; every warning is an entry of that name."""
        yield "status", self._verdict()
        yield (
            "T_target_source",
            "\n".join(" ".join(f"{x:>14.8g}" for x in row) for row in self.T_target_source),
        )
        yield "scale", f"{self.scale:.6g}"
        yield "rotation", f"{self.rotation_deg:.4f} deg"
        yield "RMSE of pairs", f"{self.rmse_matched:.6g} over {text.count(self.n_inliers, 'pair')}"
        if self.score is not None:
            reached, limit = self.score
            yield (
                "score",
                f"{reached:.5g}; proven: no pose has more than {limit:.5g} "
                "(a match counts 1 - (residual / inlier distance)^2)",
            )
        yield "lower bound", f"{self.lower_bound:.6g}"
        yield "upper bound", f"{self.upper_bound:.6g}"
        yield "gap", f"{self.gap:.4g} (tolerance {self.gap_tol:.4g})"
        yield "scope of bounds", self.certificate_scope
        bounding = [stage for stage in self.stages if stage.status is not None]
        for stage in bounding if len(bounding) > 1 else []:
            yield f"{stage.name} stage", stage.summary()
        yield (
            "objective",
            f"{self.objective:.6g} (before the polish {self.objective_certified:.6g})",
        )
        yield (
            "work",
            f"{text.count(self.n_nodes, 'node')}, {text.count(self.n_assignments, 'assignment')}",
        )
        yield "time", f"{self.time_solve_s:.2f} s solving, {self.time_setup_s:.2f} s before"
        yield "method", f"{self.model}, mode {self.mode}, bound {self.bound}"
        if self.downsampled is not None:
            n, m, pairs = self.downsampled
            yield (
                "downsampled",
                f"the bounds are of {text.count(pairs, 'pair')} of {n} and {m} farthest points; the pose "
                "is refined on all points",
            )
        if self.score is None:
            yield "best other pose", "not known" if self.rival is None else str(self.rival)
        for warning in self.warnings:
            yield "warning", warning

    def _verdict(self) -> str:
        status, scope = self.status, self.certificate_scope
        if status is Status.OPTIMAL:
            return f"optimal: certified within the tolerance, for the {scope}"
        if status is Status.CONVERGED:
            return "converged: came to its own end, not certified"
        if self.gap <= self.gap_tol:
            return (
                f"{status.value}: best pose so far; certified for the {scope}, but a later stage "
                "did not end"
            )
        return f"{status.value}: best pose so far, not certified"
