"""One cardinality of a sweep: what is searched for it, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dcreg.driver.full import rigid_space
from dcreg.driver.modes import Mode
from dcreg.driver.paper import space_of
from dcreg.driver.solve import default_tolerances, task_of
from dcreg.driver.task import Answer, Task
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.problem import Problem
from dcreg.result import Stage
from dcreg.search import Budget, Event
from dcreg.status import Status


@dataclass
class Level:
    """One cardinality: its problem, what is searched for it, what is known of that (frame units)."""

    whole: Problem
    problem: Problem
    task: Task
    space: FeatureSpace | Rigid3D
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
    def of(
        cls,
        whole: Problem,
        problem: Problem,
        mode: Mode,
        bound: str | None,
        gap_tol: float | None,
        threads: int,
        budget: Budget,
    ) -> Level:
        if gap_tol is None:
            gap_tol, rotation_tol = default_tolerances(problem, mode)
        else:
            rotation_tol = gap_tol
        task = task_of(problem, mode, bound, gap_tol, threads, budget, rotation_tol=rotation_tol)
        if mode.name == "full":
            return cls(whole, problem, task, rigid_space(task))
        return cls(whole, problem, task, space_of(task))

    @property
    def name(self) -> int:
        """The cardinality, as it was asked for."""
        return self.whole.n_inliers

    @property
    def k(self) -> int:
        """Pairs of the search."""
        return self.problem.n_inliers

    @property
    def is_sampled(self) -> bool:
        """Whether some of the points are searched, not all."""
        return self.whole is not self.problem

    @property
    def gap_tol(self) -> float:
        return self.task.gap_tol

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

    def answer(self) -> Answer:
        """What is known, but for the pose."""
        status = Status.OPTIMAL if self.closed else self.stopped_by or Status.STOPPED
        descents = Stage("descents", self.descending_s, n_assignments=self.n_descending)
        return Answer(
            np.empty(0), status, self.lower_bound, self.upper_bound, self.space.scope,
            [descents, *self.searches], list(self.events),
        )  # fmt: skip
