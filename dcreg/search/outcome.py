"""Where a search begins and how it ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from dcreg.search.boxes import Confined, Leaves
from dcreg.search.budget import Event
from dcreg.status import Status


@dataclass(frozen=True)
class Outcome:
    """The best parameter found, with bounds that hold for every status.

    Attributes
    ----------
    status : Status
    theta : (d,) array
    lower_bound, upper_bound : float
        ``lower_bound <= minimum <= upper_bound``; the latter is the objective at `theta`.
    n_nodes, n_assignments : int
        Boxes bounded, and exact assignments solved, including those of local searches.
    time_s : float
    events : list of Event
        One for each change of a bound, and one at the end.
    leaves : Leaves, optional
        The leaf boxes, if they were kept.
    confined : list of Confined
        The boxes to which a cover confined the search, in the order of the stages.
    abandoned_s : dict of str to float
        Seconds of abandoned attempts, by stage of the cover.
    """

    status: Status
    theta: np.ndarray
    lower_bound: float
    upper_bound: float
    n_nodes: int
    n_assignments: int
    time_s: float
    events: list[Event] = field(default_factory=list)
    leaves: Leaves | None = None
    confined: list[Confined] = field(default_factory=list)
    abandoned_s: dict[str, float] = field(default_factory=dict)


class Start(NamedTuple):
    """A known parameter with its objective, and the work spent on finding it."""

    theta: np.ndarray
    value: float = np.inf
    n_assignments: int = 0
    time_s: float = 0.0
