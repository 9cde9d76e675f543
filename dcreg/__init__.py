"""Globally optimal point cloud registration with the holistic DC bound (DC-Reg, arXiv 2603.25442)."""

from dcreg._version import __version__
from dcreg.polish import objective
from dcreg.problem import InputError, Problem, default_gap_tol
from dcreg.registration import register, warm_up
from dcreg.result import Result, Status
from dcreg.sweeping import SweepResult, sweep

__all__ = [
    "InputError",
    "Problem",
    "Result",
    "Status",
    "SweepResult",
    "__version__",
    "default_gap_tol",
    "objective",
    "register",
    "sweep",
    "warm_up",
]
