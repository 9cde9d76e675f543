"""Branch and bound, without geometry: boxes, bounds as a protocol, budget, outcome."""

from dcreg.search.bound import Bound, Evaluation
from dcreg.search.box import Box, LongestEdge
from dcreg.search.branch_and_bound import branch_and_bound
from dcreg.search.budget import Budget, Interrupted, Listener
from dcreg.search.leaves import Leaves
from dcreg.search.minimise import minimise
from dcreg.search.outcome import Outcome
from dcreg.search.trace import Event, Trace

__all__ = [
    "Bound",
    "Box",
    "Budget",
    "Evaluation",
    "Event",
    "Interrupted",
    "Leaves",
    "Listener",
    "LongestEdge",
    "Outcome",
    "Trace",
    "branch_and_bound",
    "minimise",
]
