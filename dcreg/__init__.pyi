"""The public names and where they live; ``__init__.py`` loads each of them on its first use."""

from . import certificate, modes, search
from .certificate import Certificate, Report, verify
from .io import read_candidates, read_matches, read_points
from .local import objective
from .matching import register_matches
from .names import bound_names, mode_names
from .plot import plot_registration, plot_sweep
from .problem import Candidates, InputError, Problem, advice, default_gap_tol, gap_tol_of
from .registration import register
from .result import Result, Stage
from .rival import Rival
from .search import Event, Listener, Trace
from .status import Status
from .sweep_result import SweepResult
from .sweeping import sweep
from .warm_up import warm_up

__version__: str

__all__ = [
    "Candidates",
    "Certificate",
    "Event",
    "InputError",
    "Listener",
    "Problem",
    "Report",
    "Result",
    "Rival",
    "Stage",
    "Status",
    "SweepResult",
    "Trace",
    "advice",
    "bound_names",
    "certificate",
    "default_gap_tol",
    "gap_tol_of",
    "mode_names",
    "modes",
    "objective",
    "plot_registration",
    "plot_sweep",
    "read_candidates",
    "read_matches",
    "read_points",
    "register",
    "register_matches",
    "search",
    "sweep",
    "verify",
    "warm_up",
]
