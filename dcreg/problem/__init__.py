"""What is to be solved: clouds, pairs and tolerance, checked before anything long starts."""

from dcreg.problem.advice import advice
from dcreg.problem.errors import InputError, suggestion
from dcreg.problem.frame import Frame
from dcreg.problem.pairs import Candidates
from dcreg.problem.pose import nearest_rotation, rotation_angle_deg, scale_of
from dcreg.problem.problem import MODEL_DIM, ModelName, Problem
from dcreg.problem.sample import farthest_points, median_spacing, representative_points
from dcreg.problem.tolerance import (
    EXACT,
    TOLERATED_NORM_RESIDUAL,
    TOLERATED_RESIDUAL,
    default_gap_tol,
    gap_tol_of,
    rms_radius,
    unit_length,
)

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
    "advice",
    "default_gap_tol",
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
