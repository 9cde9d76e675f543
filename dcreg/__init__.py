"""Globally optimal point cloud registration with the holistic DC bound (DC-Reg, arXiv 2603.25442)."""

from dcreg._version import __version__
from dcreg.certificate import Certificate, verify
from dcreg.io import read_points
from dcreg.local import objective
from dcreg.problem import InputError, Problem, default_gap_tol
from dcreg.registration import register
from dcreg.result import Result, Stage
from dcreg.search import Event, Trace
from dcreg.status import Status
from dcreg.sweeping import SweepResult, sweep
from dcreg.warm_up import warm_up

__all__ = [
    "Certificate",
    "Event",
    "InputError",
    "Problem",
    "Result",
    "Stage",
    "Status",
    "SweepResult",
    "Trace",
    "__version__",
    "default_gap_tol",
    "objective",
    "read_points",
    "register",
    "sweep",
    "verify",
    "warm_up",
]
