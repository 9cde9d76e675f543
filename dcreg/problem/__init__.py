"""The problem to solve, checked before any search, and the geometry that it needs."""

from dcreg.names import MODEL_DIM
from dcreg.problem.geometry import (
    EXACT,
    TOLERATED_NORM_RESIDUAL,
    TOLERATED_RESIDUAL,
    Frame,
    apply_pose,
    default_gap_tol,
    farthest_point_order,
    farthest_points,
    gap_tol_of,
    median_spacing,
    nearest_rotation,
    representative_points,
    rms_radius,
    rotation_angle_deg,
    scale_of,
    unit_length,
)
from dcreg.problem.problem import Candidates, InputError, ModelName, Problem, suggestion

__all__ = [
    "EXACT",
    "MODEL_DIM",
    "TOLERATED_NORM_RESIDUAL",
    "TOLERATED_RESIDUAL",
    "Candidates",
    "Frame",
    "InputError",
    "ModelName",
    "Problem",
    "apply_pose",
    "default_gap_tol",
    "farthest_point_order",
    "farthest_points",
    "gap_tol_of",
    "median_spacing",
    "nearest_rotation",
    "representative_points",
    "rms_radius",
    "rotation_angle_deg",
    "scale_of",
    "suggestion",
    "unit_length",
]
