"""One cardinality of a sweep: what is searched for it, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dcreg.driver.normalised import NormalisedProblem, Solution
from dcreg.driver.solve import Setup
from dcreg.result import Stage
from dcreg.search import Budget, Event
from dcreg.status import Status


@dataclass
class Level:
    """One cardinality: its problem, what is searched for it, what is known of that (frame units)."""

    at: int
    name: int  # the cardinality as given
    normalised: NormalisedProblem
    space: Any
    theta: np.ndarray = field(default_factory=lambda: np.empty(0))
    lower_bound: float = 0.0
    upper_bound: float = np.inf
    proven_by: int | None = None
    stopped_by: Status | None = None
    n_descending: int = 0
    descending_s: float = 0.0
    tried: list[np.ndarray] = field(default_factory=list)  # poses of others
    events: list[Event] = field(default_factory=list)
    searches: list[Stage] = field(default_factory=list)

    @classmethod
    def of(cls, setup: Setup, at: int, budget: Budget) -> Level:
        """Prepare the search for ``setup.problems[at]``."""
        normalised = setup.normalised(at, budget)
        name = setup.problems[at].n_inliers
        return cls(at, name, normalised, setup.mode.space(normalised))

    @property
    def k(self) -> int:
        """Number of pairs in the search."""
        return self.normalised.n_inliers

    @property
    def gap_tol(self) -> float:
        return self.normalised.gap_tol

    @property
    def closed(self) -> bool:
        return self.lower_bound >= self.upper_bound - self.gap_tol

    def take(self, theta: np.ndarray, value: float, spent: int = 0) -> None:
        """A pose and its objective; the better one stays."""
        self.n_descending += spent
        if value < self.upper_bound or not self.theta.size:
            self.theta, self.upper_bound = theta, value

    def inherit(self, smaller: Level) -> None:
        """The transferred lower bound of a smaller cardinality."""
        bound = self.k / smaller.k * smaller.lower_bound
        if bound > self.lower_bound:
            self.lower_bound, self.proven_by = bound, smaller.proven_by

    def solution(self) -> Solution:
        """What is known, but for the pose."""
        status = Status.OPTIMAL if self.closed else self.stopped_by or Status.STOPPED
        descents = Stage("descents", self.descending_s, n_assignments=self.n_descending)
        return Solution(
            np.empty(0), status, self.lower_bound, self.upper_bound, self.space.scope,
            [descents, *self.searches], list(self.events),
        )  # fmt: skip
