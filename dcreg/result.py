"""What a registration returns: status, pose, bounds, work and the scope of the certificate."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from dcreg.trace import Trace

if TYPE_CHECKING:
    from dcreg.certificate import Certificate


class Status(enum.StrEnum):
    """How a run ended. One vocabulary for the library, every baseline and every report."""

    OPTIMAL = "optimal"  # bounds closed to gap_tol: certified within the stated scope
    CONVERGED = "converged"  # a local or heuristic method came to its own end
    STOPPED = "stopped"  # the caller asked to stop
    TIME_LIMIT = "time_limit"
    NODE_LIMIT = "node_limit"
    MEMORY_LIMIT = "memory_limit"
    FAILED = "failed"  # raised, crashed or was killed from outside
    UNSUPPORTED = "unsupported"  # the method cannot treat this kind of problem
    UNAVAILABLE = "unavailable"  # the method is not installed here
    NOT_RUN = "not_run"

    @property
    def is_limit(self) -> bool:
        return self in (Status.TIME_LIMIT, Status.NODE_LIMIT, Status.MEMORY_LIMIT)


@dataclass(frozen=True)
class Result:
    """The outcome of `dcreg.register`, in the coordinates and units of the input files.

    Attributes
    ----------
    status : Status
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
    n_nodes, n_assignments, n_bound_evals : int
        Boxes bounded, exact assignments solved, bound evaluations: independent of threads and load,
        and the same wherever floating-point results are.
    time_setup_s, time_solve_s : float
        Wall time for preparing (validation, normalisation, JIT warm-up) and for solving.
    trace : Trace
        Bound history.
    stages : list of dict
        One row per stage (search, rotation, polish) with its own bounds, work and time.
    certificate : Certificate, optional
        The leaf boxes of the search, when asked for.
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
    n_bound_evals: int
    time_setup_s: float
    time_solve_s: float
    trace: Trace
    stages: list[dict[str, Any]] = field(default_factory=list)
    certificate: Certificate | None = None

    @property
    def gap(self) -> float:
        """Absolute gap ``upper_bound - lower_bound``, never negative."""
        return max(0.0, self.upper_bound - self.lower_bound)

    @property
    def success(self) -> bool:
        return self.status is Status.OPTIMAL

    @property
    def scale(self) -> float:
        d = self.T_target_source.shape[0] - 1
        return float(abs(np.linalg.det(self.T_target_source[:d, :d])) ** (1.0 / d))

    @property
    def rotation(self) -> np.ndarray:
        d = self.T_target_source.shape[0] - 1
        return self.T_target_source[:d, :d] / self.scale

    @property
    def translation(self) -> np.ndarray:
        d = self.T_target_source.shape[0] - 1
        return self.T_target_source[:d, d]

    @property
    def rmse_matched(self) -> float:
        """Root mean square residual of the matched pairs, in units of the target."""
        return float(np.sqrt(self.objective / self.n_inliers))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; every key is documented in the README."""
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
            "n_bound_evals": self.n_bound_evals,
            "time_setup_s": self.time_setup_s,
            "time_solve_s": self.time_solve_s,
            "certificate_scope": self.certificate_scope,
            "rmse_matched": self.rmse_matched,
            "assignment": self.assignment.tolist(),
            "stages": self.stages,
        }
