"""Branch and bound, without geometry: boxes, bounds as a protocol, budget, outcome."""

from dcreg.search.boxes import (
    Bound,
    Box,
    Boxes,
    Confined,
    Evaluation,
    Leaves,
    LongestEdge,
    Stored,
)
from dcreg.search.branch_and_bound import branch_and_bound
from dcreg.search.budget import Budget, Event, Interrupted, Listener
from dcreg.search.outcome import Outcome, Start
from dcreg.search.recording import Recorder, recording
from dcreg.search.space_search import minimise
from dcreg.search.tolerance import Tolerance, proven_share

__all__ = [
    "Bound",
    "Box",
    "Boxes",
    "Budget",
    "Confined",
    "Evaluation",
    "Event",
    "Interrupted",
    "Leaves",
    "Listener",
    "LongestEdge",
    "Outcome",
    "Recorder",
    "Start",
    "Stored",
    "Tolerance",
    "branch_and_bound",
    "minimise",
    "proven_share",
    "recording",
]
