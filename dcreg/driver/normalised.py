"""A problem in normalised units, and its solution."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dcreg.problem import Frame, PairWeights
from dcreg.result import Stage
from dcreg.search import Box, Budget, Event, Listener, Outcome, Tolerance
from dcreg.status import Status


@dataclass(frozen=True)
class NormalisedProblem:
    """One problem in the units of its frame, and how to solve it.

    Attributes
    ----------
    source, target : (n, d), (m, d) arrays
    n_inliers : int
    scale_range : (low, high)
    candidates : (n, m) bool array or None
        The feasible pairs; None: all.
    frame : Frame
        Converts to the coordinates of the input.
    bound : str
        Name of the bounding function.
    stationary_box : bool
        Start from the translations that an optimum can have, or from the box of the radii.
    tolerance : Tolerance
        Of all stages.
    threads : int
    budget : Budget
    keep_leaves : bool
        Keep the leaf boxes of the certified search.
    patience_s : float, optional
        Seconds that a proof may take, if independent starts agree; None: to the limit.
    region : Region, optional
        The admissible poses (``dcreg.families.region``); None: all of the model.
    init : (d+1, d+1) array, optional
        An initial guess of the pose.
    weights : PairWeights, optional
    """

    source: np.ndarray
    target: np.ndarray
    n_inliers: int
    scale_range: tuple[float, float]
    candidates: np.ndarray | None
    frame: Frame
    bound: str
    stationary_box: bool
    tolerance: Tolerance
    threads: int
    budget: Budget
    keep_leaves: bool = False
    patience_s: float | None = None
    region: Any = None
    init: np.ndarray | None = None
    weights: PairWeights | None = None

    @property
    def dim(self) -> int:
        return int(self.source.shape[1])


@dataclass
class Solution:
    """Pose and bounds, and the stages that led to them.

    Attributes
    ----------
    T : (d+1, d+1) array
    status : Status
    lower_bound, upper_bound : float
        Of the objective that the mode certifies.
    scope : str
        What the bounds refer to.
    stages : list of Stage
    events : list of Event
    minima : list of (pose, objective)
        Where local searches over poses ended.
    certified : (Box, Outcome), optional
        The root and the outcome of the certified search.
    """

    T: np.ndarray
    status: Status
    lower_bound: float
    upper_bound: float
    scope: str
    stages: list[Stage] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    minima: list[tuple[np.ndarray, float]] = field(default_factory=list)
    certified: tuple[Box, Outcome] | None = None

    def add(self, stage: str, found: Outcome) -> None:
        """Record one search."""
        self.stages.append(Stage.of(stage, found))
        self.events += found.events

    def to_input(self, frame: Frame) -> Solution:
        """Return the same solution in the coordinates and units of the input."""
        area = frame.area
        return replace(
            self,
            T=frame.pose(self.T),
            lower_bound=self.lower_bound * area,
            upper_bound=self.upper_bound * area,
            stages=[stage.scaled(area) for stage in self.stages],
            events=[event.scaled(area) for event in self.events],
            minima=[(frame.pose(T), value * area) for T, value in self.minima],
        )


def in_input_units(listener: Listener | None, area: float) -> Listener | None:
    """Return the listener for events in normalised units."""
    if listener is None:
        return None
    return lambda event: listener(event.scaled(area))
