"""Best-first branch and bound: Algorithm 1 of the DC-Reg paper, in rounds. Knows no geometry.

A bound maps boxes to lower bounds and offers parameters whose objective is known. Each round takes
the best open boxes, divides them, bounds the children and prunes those that cannot improve the
incumbent by more than ``gap_tol``. A round's size is fixed by the problem and its boxes are
independent, so the result does not depend on how many threads evaluate them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from dcreg.search.boxes import Bound, Evaluation, Leaves, LongestEdge, OpenNodes
from dcreg.search.budget import Budget, Event, Interrupted
from dcreg.status import Status


@dataclass(frozen=True)
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
    leaves : Leaves, optional
        The undivided boxes, if they were kept.
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


# A descent starts where the round's best value is no worse than the last start's times this factor per
# round since: often while the search finds better and better places, seldom when it only closes the gap.
REFINING_PATIENCE = 1.01

MIN_ROUND = 16  # boxes a round divides at least, if the search allows as many


class Start(NamedTuple):
    """A known parameter with its objective, and what it took to find it."""

    theta: np.ndarray
    value: float = np.inf
    n_assignments: int = 0
    time_s: float = 0.0


# theta -> (better theta, its objective, assignments spent): descent from a promising parameter
Refine = Callable[[np.ndarray], tuple[np.ndarray, float, int]]
Branching = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def branch_and_bound(
    bound: Bound,
    budget: Budget,
    *,
    branching: Branching,
    gap_tol: float,
    refine: Refine | None = None,
    start: Sequence[Any] | None = None,
    stage: str = "search",
    keep_leaves: bool = False,
) -> Outcome:
    """Minimise a function over boxes to within `gap_tol`, by Algorithm 1 of DC-Reg.

    Parameters
    ----------
    bound : Bound
        The function is known through it alone, and must be non-negative. ``bound.roots`` are searched,
        a round dividing at most ``bound.round_size`` boxes: a share of those there are, so that while few
        are open the next ones are chosen with care.
    budget : Budget
        Its listener is told of every round; what is left of it ends the search.
    branching : callable
        Divides every box into equally many, those of a box next to each other.
    gap_tol : float
        Stop when ``upper_bound - lower_bound <= gap_tol`` (the paper's epsilon).
    refine : callable, optional
        Local descent, tried from the most promising parameter of each round.
    start : Start or (theta, value), optional
        A known admissible parameter and its objective: the first incumbent.
    stage : str
        Name of this search in its events.
    keep_leaves : bool
        Keep the leaf boxes with their bounds, for a certificate.

    Returns
    -------
    Outcome
        ``lower_bound <= min <= upper_bound`` whatever the status.
    """
    began = budget.elapsed()
    first = Start(bound.roots[0].centre) if start is None else Start(*start)
    search = _Search(bound, budget, gap_tol, stage, Leaves() if keep_leaves else None, first)
    lower = np.array([box.lower for box in bound.roots])
    upper = np.array([box.upper for box in bound.roots])
    inherited = np.zeros(len(lower))  # the objective is a sum of squares
    warm_start: np.ndarray | None = None
    while search.status is None:
        try:
            found = bound.evaluate(lower, upper, search.cutoff, warm_start)
        except Interrupted:
            search.put_back(lower, upper, inherited, warm_start)
            break
        bounds = np.maximum(_settled(found.lower_bounds, gap_tol), inherited)
        search.update(found, refine)
        search.prune(lower, upper, bounds, found.warm_start)
        search.terminate()
        if search.status is None:
            lower, upper, inherited, kept = search.select()
            lower, upper = branching(lower, upper)
            parts = len(lower) // len(inherited)
            inherited = np.repeat(inherited, parts)
            warm_start = None if kept is None else np.repeat(kept, parts, axis=0)
    return search.outcome(first.time_s + budget.elapsed() - began)


class _Search:
    """The state of one search; its methods are the steps of Algorithm 1."""

    def __init__(
        self,
        bound: Bound,
        budget: Budget,
        gap_tol: float,
        stage: str,
        leaves: Leaves | None,
        start: Start,
    ) -> None:
        self.bound, self.budget, self.gap_tol = bound, budget, gap_tol
        self.stage, self.leaves = stage, leaves
        self.theta, self.upper_bound = start.theta, start.value
        self.nodes = OpenNodes(bound.roots[0].dim)
        self.pruned_bound = np.inf  # least bound among pruned boxes: part of the certificate
        self.n_nodes, self.n_refining = 0, start.n_assignments
        self.worth_refining = np.inf
        self.is_over = False
        self.status: Status | None = None
        self.events: list[Event] = []

    @property
    def cutoff(self) -> float:
        """Boxes whose bound reaches this cannot improve the incumbent by more than the tolerance."""
        return self.upper_bound - self.gap_tol

    @property
    def lower_bound(self) -> float:
        return min(self.nodes.lower_bound, self.pruned_bound, self.upper_bound)

    def update(self, found: Evaluation, refine: Refine | None) -> None:
        """Take the round's best parameter for the incumbent, if it is one, and descend from it."""
        best = int(np.argmin(_settled(found.values, self.gap_tol)))
        value = float(found.values[best])
        self._take(found.thetas[best], value)
        self.is_over = self.budget.is_over
        if refine is not None and not self.is_over and value <= self.worth_refining:
            self.worth_refining = value
            try:
                theta, value, spent = refine(found.thetas[best])
            except Interrupted:
                self.is_over = True
                return
            self.n_refining += spent
            self._take(theta, value)
        self.worth_refining *= REFINING_PATIENCE

    def _take(self, theta: np.ndarray, value: float) -> None:
        if value < self.upper_bound:
            self.theta, self.upper_bound = theta.copy(), value

    def prune(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        bounds: np.ndarray,
        warm_start: np.ndarray | None,
    ) -> None:
        """Keep the boxes that may still hold something better."""
        self.n_nodes += len(bounds)
        keep = bounds < self.cutoff
        if not keep.all():
            self.pruned_bound = min(self.pruned_bound, float(bounds[~keep].min()))
            if self.leaves is not None:
                self.leaves.add(lower[~keep], upper[~keep], bounds[~keep])
        self.nodes.push(
            lower[keep], upper[keep], bounds[keep], None if warm_start is None else warm_start[keep]
        )

    def put_back(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        bounds: np.ndarray,
        warm_start: np.ndarray | None = None,
    ) -> None:
        """End with boxes open that there was no time to bound."""
        self.nodes.push(lower, upper, bounds, warm_start)
        self.is_over = True
        self.terminate()

    def terminate(self) -> None:
        """Set the status if the search has come to an end, and tell of the round."""
        budget = self.budget
        if self.lower_bound >= self.cutoff:
            self.status = Status.OPTIMAL
        elif self.is_over:
            self.status = budget.ended_by
        elif budget.nodes is not None and self.n_nodes >= budget.nodes:
            self.status = Status.NODE_LIMIT
        elif budget.memory_mb is not None and self.nodes.nbytes > budget.memory_mb * 2**20:
            self.status = Status.MEMORY_LIMIT
        self._report("bound" if self.status is None else "end")
        if budget.stopped and self.status is None:
            self.status = Status.STOPPED
            self._report("end")

    def select(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """The best open boxes, to be divided next, with their bounds and warm_start."""
        count = min(self.bound.round_size, max(MIN_ROUND, len(self.nodes) // 4))
        return self.nodes.pop(count, self.cutoff)

    def outcome(self, time_s: float) -> Outcome:
        lower_bound = self.lower_bound
        if self.leaves is not None and len(self.nodes):
            is_open = self.status is not Status.OPTIMAL
            self.leaves.add(*self.nodes.pop(len(self.nodes), np.inf)[:3], is_open=is_open)
        assert self.status is not None
        return Outcome(
            self.status,
            self.theta,
            lower_bound,
            self.upper_bound,
            self.n_nodes,
            self.bound.n_assignments + self.n_refining,
            time_s,
            self.events,
            self.leaves,
        )

    def _report(self, kind: str) -> None:
        event = Event(
            kind,
            self.stage,
            self.budget.elapsed(),
            self.n_nodes,
            self.bound.n_assignments + self.n_refining,
            len(self.nodes),
            self.lower_bound,
            self.upper_bound,
            self.status.value if self.status is not None else "",
        )
        if kind == "bound" and self.events and _same_bounds(self.events[-1], event):
            event = replace(event, kind="heartbeat")  # told to the listener, not kept
        else:
            self.events.append(event)
        self.budget.tell(event)


def _settled(values: np.ndarray, gap_tol: float) -> np.ndarray:
    """The values lowered to a grid far below the tolerance.

    Boxes that share a vertex often have equal bounds up to rounding. On the grid they are equal, so that
    the order of the search, and with it all counters, does not hang on the last bits of a machine.
    """
    step = 1e-6 * gap_tol
    return step * (np.round(values / step) - 1.0) if step > 0.0 else values


def _same_bounds(a: Event, b: Event) -> bool:
    return a.lower_bound == b.lower_bound and a.upper_bound == b.upper_bound


class Searchable(Protocol):
    """What a search asks of a parameter space."""

    axis_weights: np.ndarray

    def start(self, budget: Budget, enough: float) -> tuple[np.ndarray, float, int]:
        """A first incumbent: theta, objective, assignments spent. None below `enough` is sought."""
        ...

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Descent from `theta`: a better theta, its objective, assignments spent."""
        ...


def minimise(
    space: Searchable,
    bound: Bound,
    budget: Budget,
    *,
    gap_tol: float,
    start: Sequence[Any] | None = None,
    stage: str = "search",
    keep_leaves: bool = False,
) -> Outcome:
    """Least objective over the roots of `bound`, to within `gap_tol`.

    Parameters
    ----------
    space : Searchable
        Gives the first incumbent, the descents, and the weights by which boxes are divided.
    bound : Bound
    budget : Budget
    gap_tol : float
        Absolute, in the units of the objective.
    start : (theta, value), optional
        A known parameter and its objective; default: what ``space.start`` finds.
    stage : str
        Name of this search in its events.
    keep_leaves : bool
        Keep the leaf boxes for a certificate.

    Returns
    -------
    Outcome
    """
    if start is None:
        began = budget.elapsed()
        start = space.start(budget, gap_tol)
        start = Start(*start, budget.elapsed() - began)
    return branch_and_bound(
        bound,
        budget,
        branching=LongestEdge(space.axis_weights),
        gap_tol=gap_tol,
        refine=space.refine,
        start=start,
        stage=stage,
        keep_leaves=keep_leaves,
    )
