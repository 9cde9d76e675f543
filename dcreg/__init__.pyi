"""The public names and where they live; ``__init__.py`` loads each of them on its first use."""

from . import certificate, search
from .api import register, register_matches, sweep
from .assignment.objective import objective
from .certificate import Certificate
from .certificate.report import Report
from .certificate.verification import verify
from .diagnostics import advice
from .driver.options import SolveOptions
from .driver.warm_up import warm_up
from .io import read_candidates, read_matches, read_points, read_pose, read_weights
from .io.attributes import read_attributes
from .io.g2o import PoseEdge, write_pose_graph
from .io.moved import write_moved
from .names import bound_names, mode_names
from .plot import plot_answer, plot_registration, plot_sweep
from .problem.attributes import Attributes
from .problem.errors import InputError
from .problem.pose_range import PoseRange
from .problem.problem import Candidates, Problem
from .problem.uncertainty import OpenDirection
from .problem.weights import PointWeights
from .questions.alternatives import Alternative, Alternatives, alternatives
from .questions.certify import Certified, certify
from .questions.inliers import MaxInliers, max_inliers
from .result import Result
from .result_parts import ChosenNumber, RunnerUp, Stage, Trace
from .search import Event, Listener
from .status import Status
from .sweep_result import SweepResult

__version__: str

__all__ = [
    "Alternative",
    "Alternatives",
    "Attributes",
    "Candidates",
    "Certificate",
    "Certified",
    "ChosenNumber",
    "Event",
    "InputError",
    "Listener",
    "MaxInliers",
    "OpenDirection",
    "PointWeights",
    "PoseEdge",
    "PoseRange",
    "Problem",
    "Report",
    "Result",
    "RunnerUp",
    "SolveOptions",
    "Stage",
    "Status",
    "SweepResult",
    "Trace",
    "advice",
    "alternatives",
    "bound_names",
    "certificate",
    "certify",
    "max_inliers",
    "mode_names",
    "objective",
    "plot_answer",
    "plot_registration",
    "plot_sweep",
    "read_attributes",
    "read_candidates",
    "read_matches",
    "read_points",
    "read_pose",
    "read_weights",
    "register",
    "register_matches",
    "search",
    "sweep",
    "verify",
    "warm_up",
    "write_moved",
    "write_pose_graph",
]
