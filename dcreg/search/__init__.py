"""Branch and bound, without geometry: boxes, bounds as a protocol, budget, outcome."""

from dcreg.search.boxes import Bound, Box, Boxes, Evaluation, Leaves, LongestEdge
from dcreg.search.branch_and_bound import Outcome, branch_and_bound, minimise
from dcreg.search.budget import (
    Budget,
    Event,
    Interrupted,
    Listener,
    Tolerance,
    Trace,
    proven_share,
)

__all__ = [
    "Bound",
    "Box",
    "Boxes",
    "Budget",
    "Evaluation",
    "Event",
    "Interrupted",
    "Leaves",
    "Listener",
    "LongestEdge",
    "Outcome",
    "Tolerance",
    "Trace",
    "branch_and_bound",
    "minimise",
    "proven_share",
]
