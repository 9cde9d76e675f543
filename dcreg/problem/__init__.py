"""The problem to solve, checked before any search, and the geometry that it needs."""

# ruff: noqa: F401 (names of the package)

from dcreg.problem.errors import InputError, suggestion
from dcreg.problem.frame import Frame
from dcreg.problem.geometry import (
    Moments,
    angle_between_deg,
    apply_pose,
    exact_objective,
    farthest_point_order,
    farthest_points,
    median_spacing,
    nearest_rotation,
    representative_points,
    rms_radius,
    rotation_angle_deg,
    rotation_axis,
    rounding_error,
    scale_of,
    typical_radius,
    unit_length,
)
from dcreg.problem.pose_range import PoseRange, checked_pose
from dcreg.problem.problem import Candidates, Problem, largest_matching
from dcreg.problem.uncertainty import (
    OpenDirection,
    open_directions,
    pose_covariance,
)
from dcreg.problem.weights import PairWeights, PointWeights
