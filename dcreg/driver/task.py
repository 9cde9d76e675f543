"""What a mode is asked, and what it answers; both in normalised units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dcreg.result import Stage
from dcreg.search import Box, Budget, Event, Leaves, Outcome
from dcreg.status import Status


@dataclass(frozen=True)
class Task:
    """One normalised problem and how it is to be solved.

    Attributes
    ----------
    source, target : (n, d), (m, d) arrays
    n_inliers : int
    scale_range : (low, high)
    candidates : (n, m) bool array or None
        The feasible pairs; None: all.
    bound : str
        Name of the bounding function, for modes that take one.
    reduced_box : bool
        Start from the translations that an optimum can have, or from the plain safe box.
    gap_tol : float
    threads : int
    budget : Budget
    leaves : Leaves or None
        Collects the leaves of the search that a certificate is made of.
    rotation_tol : float, optional
        The gap asked of rotation searches, whose residuals are larger than those of norms; default:
        `gap_tol`.
    """

    source: np.ndarray
    target: np.ndarray
    n_inliers: int
    scale_range: tuple[float, float]
    candidates: np.ndarray | None
    bound: str
    reduced_box: bool
    gap_tol: float
    threads: int
    budget: Budget
    leaves: Leaves | None = None
    rotation_tol: float | None = None

    @property
    def turning_tol(self) -> float:
        """The gap asked of rotation searches."""
        return self.gap_tol if self.rotation_tol is None else self.rotation_tol

    @property
    def dim(self) -> int:
        return int(self.source.shape[1])


@dataclass
class Answer:
    """Pose and bounds, and the stages that led there.

    Attributes
    ----------
    T : (d+1, d+1) array
        The pose between the normalised clouds.
    status : Status
    lower_bound, upper_bound : float
        Of the objective that the mode certifies.
    scope : str
        What these bounds speak of.
    stages : list of Stage
    events : list of Event
    ends : list of (pose, objective)
        Where descents over poses ended.
    cover : (Box, Outcome), optional
        The root and the outcome of the search whose leaves were collected.
    """

    T: np.ndarray
    status: Status
    lower_bound: float
    upper_bound: float
    scope: str
    stages: list[Stage] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    ends: list[tuple[np.ndarray, float]] = field(default_factory=list)
    cover: tuple[Box, Outcome] | None = None

    def add(self, stage: str, found: Outcome) -> None:
        """Account for one search."""
        self.stages.append(Stage.of(stage, found))
        self.events += found.events
