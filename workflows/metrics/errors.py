"""Errors of a pose against the ground truth, and whether it counts as a success."""

from __future__ import annotations

import numpy as np

from dcreg.problem import nearest_rotation, rotation_angle_deg, scale_of
from workflows.metrics.case import Case, metric

# A run succeeds when its error above the floor is below this share of the longest side (of the shape at
# the reference scale; of recorded data: of the bounding box of the target's true inliers), unless the
# dataset's benchmark has its own threshold.
SUCCESS_SHARE = 0.05
# Rounding of a scale, and of a rotation's entries, at which a pose still counts as admissible.
ADMISSIBLE_ROUNDING = 1e-6


@metric("target unit", "lower", np.inf, axis="RMSE", recorded=True)
def rmse(case: Case) -> float:
    """RMS distance of the true pairs at the found pose."""
    return case.rmse


@metric("target unit", "lower", np.inf, axis="RMSE above the floor")
def rmse_excess(case: Case) -> float:
    """Error above the floor: sqrt(rmse² - rmse_floor²)."""
    return case.rmse_excess


@metric("source unit", "lower", np.inf, axis="RMSE / scale")
def rmse_over_scale(case: Case) -> float:
    """RMSE divided by the scale of the reference pose."""
    return case.rmse / scale_of(case.T_true)


@metric("degree", "lower", 180.0, axis="rotation error (°)")
def rotation_error_deg(case: Case) -> float:
    """Angle between the found and the reference orientation, 0 to 180."""
    d = case.dim
    found, true = (nearest_rotation(T[:d, :d]) for T in (case.T, case.T_true))
    return abs(rotation_angle_deg(found @ true.T))


@metric("target unit", "lower", np.inf, axis="translation error")
def translation_error(case: Case) -> float:
    """Length of t - t_reference."""
    return float(np.linalg.norm((case.T - case.T_true)[: case.dim, case.dim]))


@metric("1", "lower", np.inf, axis="scale error")
def scale_error(case: Case) -> float:
    """|scale / reference scale - 1|."""
    return abs(scale_of(case.T) / scale_of(case.T_true) - 1.0)


@metric("target unit", "none")
def rmse_true(case: Case) -> float:
    """RMSE of the reference pose."""
    return case.rms_at(case.T_true)


@metric("target unit", "none")
def rmse_floor(case: Case) -> float:
    """RMSE of the admissible pose fitted to the true pairs: the minimum over all admissible poses."""
    return case.rmse_floor


@metric("yes/no", "higher", 0.0, recorded=True)
def success(case: Case) -> bool:
    """Whether rmse_excess is below 0.05 of the longest side of the shape (of recorded data: of the
    target's true inliers) or, if the card of the dataset states limits on errors, whether all these
    errors are below their limits."""
    if case.success_limits:
        errors = {
            "rmse": rmse, "rotation_error_deg": rotation_error_deg,
            "translation_error": translation_error,
        }  # fmt: skip
        return all(errors[name](case) < limit for name, limit in case.success_limits.items())
    return case.rmse_excess < SUCCESS_SHARE * case.longest_side


@metric("yes/no", "higher", 0.0)
def admissible(case: Case) -> bool:
    """Whether the pose is of the model and its scale within the given range."""
    linear, (low, high) = case.T[: case.dim, : case.dim], case.scale_range
    scale, slack = scale_of(case.T), ADMISSIBLE_ROUNDING
    if not low * (1 - slack) <= scale <= high * (1 + slack):
        return False
    return bool(np.abs(linear - scale * nearest_rotation(linear)).max() <= slack * scale)


@metric("1 or 0", "none")
def truth_in_cube(case: Case) -> float:
    """1 if the cube of translations that the method searches contains the reference pose, 0 if not;
    empty for methods without such a cube."""
    return case.truth_in_cube
