"""What a search found."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dcreg.search.trace import Event
from dcreg.status import Status


@dataclass
class Outcome:
    """The best parameter found, with bounds that hold whatever the status.

    Attributes
    ----------
    status : Status
    theta : (d,) array
    lower_bound, upper_bound : float
        ``lower_bound <= minimum <= upper_bound``; the latter is the objective at `theta`.
    n_nodes, n_assignments : int
        Boxes bounded, exact assignments solved (descents included).
    time_s : float
    events : list of Event
        One per change of a bound, and a closing one.
    """

    status: Status
    theta: np.ndarray
    lower_bound: float
    upper_bound: float
    n_nodes: int
    n_assignments: int
    time_s: float
    events: list[Event] = field(default_factory=list)
