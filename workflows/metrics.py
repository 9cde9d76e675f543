"""Every quality metric, in one table: computed by the harness, from the pose and the truth alone.

A metric is a function of a `Case`. Adding one is adding one entry to `METRICS`; no run is repeated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from data.sampling import transform
from dcreg.problem import nearest_rotation, rotation_angle_deg, scale_of

# A run succeeds when its RMSE is below this share of the longest side of the bounding box of the
# target's true inliers ...
SUCCESS_SHARE = 0.05
# ... or below this length where a benchmark has its own threshold (3DMatch: 0.2 m).
SUCCESS_LENGTH = {"threedmatch": 0.2}


@dataclass(frozen=True)
class Case:
    """A pose to judge, with everything needed to judge it."""

    T: np.ndarray
    T_true: np.ndarray
    source: np.ndarray
    target: np.ndarray
    pairs: np.ndarray
    n_inliers: int
    dataset: str
    lower_bound: float = np.nan

    @property
    def dim(self) -> int:
        return self.source.shape[1]

    @cached_property
    def residuals(self) -> np.ndarray:
        """Vectors from the moved true inliers to their partners."""
        return transform(self.T, self._inliers[0]) - self._inliers[1]

    @cached_property
    def success_threshold(self) -> float:
        longest = float(np.ptp(self._inliers[1], axis=0).max())
        return SUCCESS_LENGTH.get(self.dataset, SUCCESS_SHARE * longest)

    @cached_property
    def objective(self) -> float:
        return _objective(self, self.T)

    @cached_property
    def objective_true(self) -> float:
        return _objective(self, self.T_true)

    @cached_property
    def _inliers(self) -> tuple[np.ndarray, np.ndarray]:
        return self.source[self.pairs[:, 0]], self.target[self.pairs[:, 1]]


class Metric(NamedTuple):
    """``worst`` stands in for runs without a pose wherever runs are ranked or summarised."""

    unit: str
    better: Literal["lower", "higher", "none"]
    worst: float
    meaning: str
    compute: Callable[[Case], float] | None  # None: filled in by `evaluate.relate`


def rmse(case: Case) -> float:
    return _rms(case.residuals)


def rmse_over_scale(case: Case) -> float:
    return rmse(case) / scale_of(case.T_true)


def rmse_true(case: Case) -> float:
    return _rms(transform(case.T_true, case._inliers[0]) - case._inliers[1])


def rmse_floor(case: Case) -> float:
    from dcreg.local import fit_pose

    source, target = case._inliers
    if len(source) < case.dim:
        return float("nan")
    scale_range = (1.0, 1.0) if case.dim == 3 else (0.0, np.inf)
    best = fit_pose(source, target, scale_range)
    return _rms(transform(best, source) - target)


def rotation_error_deg(case: Case) -> float:
    """Angle of the rotation from the true to the found orientation, 0 to 180."""
    d = case.dim
    found, true = (nearest_rotation(T[:d, :d]) for T in (case.T, case.T_true))
    return abs(rotation_angle_deg(found @ true.T))


def translation_error(case: Case) -> float:
    return float(np.linalg.norm((case.T - case.T_true)[: case.dim, case.dim]))


def scale_error(case: Case) -> float:
    return abs(scale_of(case.T) / scale_of(case.T_true) - 1.0)


def success(case: Case) -> bool:
    return rmse(case) < case.success_threshold


def bound_violation(case: Case) -> float:
    """How far a claimed lower bound lies above a value that the truth attains: must be 0."""
    excess = case.lower_bound - case.objective_true
    rounding = 1e-9 * max(1.0, abs(case.objective_true))
    return float(excess) if excess > rounding else 0.0


METRICS: dict[str, Metric] = {
    "rmse": Metric(
        "target unit", "lower", np.inf, "RMS distance of moved true inliers to their partners", rmse
    ),
    "rmse_over_scale": Metric(
        "source unit", "lower", np.inf, "rmse divided by the true scale", rmse_over_scale
    ),
    "rotation_error_deg": Metric(
        "degree", "lower", 180.0, "angle between found and true orientation", rotation_error_deg
    ),
    "translation_error": Metric(
        "target unit", "lower", np.inf, "length of t - t_true", translation_error
    ),
    "scale_error": Metric("1", "lower", np.inf, "|scale / true scale - 1|", scale_error),
    "success": Metric(
        "yes/no", "higher", 0.0, "rmse below 0.05 longest side of the target (3DMatch: 0.2 m)",
        success,
    ),
    "objective": Metric(
        "target unit²", "lower", np.inf,
        "least sum of squared residuals of n_inliers one-to-one pairs at the pose",
        lambda case: case.objective,
    ),
    "objective_true": Metric(
        "target unit²", "none", np.nan, "the same sum at the true pose",
        lambda case: case.objective_true,
    ),
    "objective_best": Metric(
        "target unit²", "none", np.nan,
        "least sum at any pose known for the instance and n_inliers: all methods' and the true one",
        None,
    ),
    "objective_regret": Metric(
        "target unit²", "lower", np.inf, "objective - objective_best", None
    ),
    "rmse_true": Metric("target unit", "none", np.nan, "RMSE of the true pose", rmse_true),
    "rmse_floor": Metric(
        "target unit", "none", np.nan, "RMSE of the pose fitted to the true pairs", rmse_floor
    ),
    "bound_violation": Metric(
        "target unit²", "lower", np.nan,
        "lower_bound above objective_true: a wrong certificate unless 0", bound_violation,
    ),
}  # fmt: skip


def _rms(residuals: np.ndarray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _objective(case: Case, T: np.ndarray) -> float:
    import dcreg

    value, _ = dcreg.objective(case.source, case.target, T, case.n_inliers)
    return float(value)
