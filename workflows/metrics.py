"""Every quality metric, in one table: computed by the harness, from the pose and the truth alone.

A metric is a function of a `Case`. Adding one is adding one entry to `METRICS`; no run is repeated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from data.sampling import reference_pose, transform
from dcreg.problem import nearest_rotation, rotation_angle_deg, scale_of

# A run succeeds when its error above the floor is below this share of the longest side of the
# bounding box of the target's true inliers ...
SUCCESS_SHARE = 0.05
# ... or its RMSE below this length where a benchmark has its own threshold (3DMatch: 0.2 m).
SUCCESS_LENGTH = {"threedmatch": 0.2}
# Rounding of a scale, and of a rotation's entries, at which a pose still counts as admissible.
ADMISSIBLE_ROUNDING = 1e-6

# Scopes in which the certified objective is that of `dcreg.objective` ...
POSE_SCOPES = ("similarity pose", "rigid pose")
# ... and those in which it is at most that at every pose: distances of norms are below those of points.
NORM_SCOPES = ("translation in norm space",)
BELOW_OBJECTIVE = (*POSE_SCOPES, *NORM_SCOPES)


@dataclass(frozen=True)
class Case:
    """A pose to judge, with everything needed to judge it."""

    T: np.ndarray
    T_true: np.ndarray
    source: np.ndarray
    target: np.ndarray
    pairs: np.ndarray
    n_inliers: int
    scale_range: tuple[float, float]
    dataset: str
    lower_bound: float = np.nan
    marks: np.ndarray | None = None  # (k, 2 d): see `workflows.instances.Truth`
    scope: str = ""  # what the lower bound speaks of
    is_thinned: bool = False  # the method was given some of the points: another objective

    @property
    def dim(self) -> int:
        return self.source.shape[1]

    @cached_property
    def residuals(self) -> np.ndarray:
        """Vectors from the moved true inliers to their partners."""
        return transform(self.T, self._inliers[0]) - self._inliers[1]

    @cached_property
    def longest_side(self) -> float:
        return float(np.ptp(self._inliers[1], axis=0).max())

    @cached_property
    def rmse_floor(self) -> float:
        source, target = self._inliers
        if len(source) < self.dim:
            return float("nan")
        rows = np.column_stack([np.arange(len(source))] * 2)
        best = reference_pose(source, target, rows, self.scale_range)
        return _rms(transform(best, source) - target)

    @cached_property
    def objective(self) -> float:
        return _objective(self, self.T)

    @cached_property
    def objective_true(self) -> float:
        return _objective(self, self.T_true)

    @cached_property
    def _inliers(self) -> tuple[np.ndarray, np.ndarray]:
        if self.marks is not None:
            return self.marks[:, : self.dim], self.marks[:, self.dim :]
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


def rmse_excess(case: Case) -> float:
    # A pose outside the scale range can lie below the floor.
    return float(np.sqrt(max(0.0, rmse(case) ** 2 - case.rmse_floor**2)))


def admissible(case: Case) -> bool:
    linear, (low, high) = case.T[: case.dim, : case.dim], case.scale_range
    scale, slack = scale_of(case.T), ADMISSIBLE_ROUNDING
    if not low * (1 - slack) <= scale <= high * (1 + slack):
        return False
    return bool(np.abs(linear - scale * nearest_rotation(linear)).max() <= slack * scale)


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
    if case.dataset in SUCCESS_LENGTH:
        return rmse(case) < SUCCESS_LENGTH[case.dataset]
    return rmse_excess(case) < SUCCESS_SHARE * case.longest_side


def bound_violation(case: Case) -> float:
    """How far a claimed lower bound lies above a value that the truth attains: must be 0.

    NaN where the two cannot be compared.
    """
    if case.scope not in BELOW_OBJECTIVE or np.isnan(case.lower_bound + case.objective_true):
        return float("nan")
    excess = case.lower_bound - case.objective_true
    rounding = 1e-9 * max(1.0, abs(case.objective_true))
    return float(excess) if excess > rounding else 0.0


METRICS: dict[str, Metric] = {
    "rmse": Metric(
        "target unit", "lower", np.inf, "RMS distance of moved true inliers to their partners", rmse
    ),
    "rmse_over_scale": Metric(
        "source unit", "lower", np.inf, "rmse divided by the reference scale", rmse_over_scale
    ),
    "rotation_error_deg": Metric(
        "degree", "lower", 180.0, "angle between found and reference orientation", rotation_error_deg
    ),
    "translation_error": Metric(
        "target unit", "lower", np.inf, "length of t - t_reference", translation_error
    ),
    "scale_error": Metric("1", "lower", np.inf, "|scale / reference scale - 1|", scale_error),
    "success": Metric(
        "yes/no", "higher", 0.0,
        "rmse_excess below 0.05 longest side of the target's true inliers (3DMatch: rmse below 0.2 m)",
        success,
    ),
    "admissible": Metric(
        "yes/no", "higher", 0.0, "the pose is of the model and its scale in the told range", admissible
    ),
    "objective": Metric(
        "target unit²", "lower", np.inf,
        "least sum of squared residuals of n_inliers one-to-one pairs at the pose; empty for large "
        "clouds, and where the method was given some of the points",
        lambda case: case.objective,
    ),
    "objective_true": Metric(
        "target unit²", "none", np.nan, "the same sum at the reference pose",
        lambda case: case.objective_true,
    ),
    "objective_best": Metric(
        "target unit²", "none", np.nan,
        "least sum at any admissible pose known for the instance and n_inliers: all methods' and the "
        "reference",
        None,
    ),
    "objective_regret": Metric(
        "target unit²", "lower", np.inf, "objective - objective_best; empty if not admissible", None
    ),
    "rmse_true": Metric("target unit", "none", np.nan, "RMSE of the reference pose", rmse_true),
    "rmse_floor": Metric(
        "target unit", "none", np.nan, "least RMSE of an admissible pose: fitted to the true pairs",
        lambda case: case.rmse_floor,
    ),
    "rmse_excess": Metric(
        "target unit", "lower", np.inf, "error above the floor: sqrt(rmse² - rmse_floor²)", rmse_excess
    ),
    "bound_violation": Metric(
        "target unit²", "lower", np.nan,
        "lower_bound above objective_true: a wrong certificate unless 0; empty if of another objective",
        bound_violation,
    ),
}  # fmt: skip


def _rms(residuals: np.ndarray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _objective(case: Case, T: np.ndarray) -> float:
    import dcreg
    from dcreg.assignment.objective import is_large

    if case.is_thinned or is_large(len(case.source), len(case.target)):
        return float("nan")  # of large clouds it takes seconds, for every run
    value, _ = dcreg.objective(case.source, case.target, T, case.n_inliers)
    return float(value)
