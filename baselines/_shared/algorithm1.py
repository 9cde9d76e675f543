"""Algorithm 1 of DC-Reg (arXiv 2603.25442), step by step, and nothing else.

In each step, the box with the lowest bound is bisected along its longest edge, and both children are
bounded. The only incumbents are the candidates that the bounds return. There are no initial poses and
no local searches, and a bound may be negative.

Other methods that divide boxes of poses have separate searches with the same loop
(`baselines._shared.own_search`), because we do not know the loops of their authors.
"""

from __future__ import annotations

import heapq
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from dcreg.search import Box, Budget, Event, Interrupted, Outcome
from dcreg.status import Status


class Bounded(NamedTuple):
    """The bound of one box, a candidate (for DC-Reg the minimising vertex), and its objective."""

    lower_bound: float
    theta: np.ndarray
    value: float


class Bounding(Protocol):
    """A bound of boxes, see `baselines._shared.published` and `baselines._shared.relaxations`."""

    @property
    def n_assignments(self) -> int: ...

    def evaluate(self, boxes: list[Box]) -> list[Bounded]:
        """Bound each box; raise `Interrupted` if the time is over."""
        ...


def algorithm_1(
    bound: Bounding,
    roots: Sequence[Box],
    epsilon: float,
    budget: Budget,
    *,
    stage: str = "search",
    raise_children: bool = False,
) -> Outcome:
    """Minimise a function over boxes to within `epsilon`.

    Parameters
    ----------
    bound : Bounding
    roots : sequence of Box
        The start box, or several that together contain every parameter.
    epsilon : float
        Boxes with ``lower_bound >= upper_bound - epsilon`` are pruned.
    budget : Budget
    stage : str
        Name of this search in its events.
    raise_children : bool
        Raise the bound of a child to that of its parent, which the paper does not do.

    Returns
    -------
    Outcome
        ``n_nodes`` counts bounded boxes.
    """
    began = budget.elapsed()
    search = _Search(bound, epsilon, budget, stage, roots[0].centre, _bytes_of(roots[0]))
    boxes, least = list(roots), -np.inf
    while search.status is None:
        try:
            found = bound.evaluate(boxes)
        except Interrupted:
            search.put_back(boxes, least)
            break
        for box, of_box in zip(boxes, found, strict=True):
            search.add(box, of_box, least if raise_children else -np.inf)
        search.terminate()
        if search.status is None:
            least, box = search.take_lowest()
            boxes = bisected(box)
    assert search.status is not None
    return Outcome(
        search.status, search.theta, search.lower_bound, search.upper_bound, search.n_nodes,
        bound.n_assignments, budget.elapsed() - began, search.events,
    )  # fmt: skip


def bisected(box: Box) -> list[Box]:
    """Bisect a box along its longest edge."""
    axis = int(np.argmax(box.upper - box.lower))
    centre = box.centre[axis]
    first, second = box.upper.copy(), box.lower.copy()
    first[axis] = second[axis] = centre
    return [Box(box.lower, first), Box(second, box.upper)]


@dataclass
class _Search:
    """Open boxes and the incumbent."""

    bound: Bounding
    epsilon: float
    budget: Budget
    stage: str
    theta: np.ndarray
    bytes_per_box: int
    lower_bound: float = (
        -np.inf
    )  # the highest so far: without raising, bounds of children may be lower
    upper_bound: float = np.inf
    n_nodes: int = 0
    pruned_bound: float = np.inf
    status: Status | None = None
    events: list[Event] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.open: list[tuple[float, int, Box]] = []  # a heap; equal bounds: the older box first
        self._age = itertools.count()

    def add(self, box: Box, found: Bounded, least: float) -> None:
        """Update the incumbent, and keep the box unless it is pruned."""
        self.n_nodes += 1
        if found.value < self.upper_bound:
            self.theta, self.upper_bound = found.theta, found.value
        self._keep(box, max(found.lower_bound, least))

    def _keep(self, box: Box, lower_bound: float) -> None:
        if lower_bound >= self.upper_bound - self.epsilon:
            self.pruned_bound = min(self.pruned_bound, lower_bound)
        else:
            heapq.heappush(self.open, (lower_bound, next(self._age), box))

    def put_back(self, boxes: list[Box], lower_bound: float) -> None:
        """End the search with boxes that were not bounded in time."""
        for box in boxes:
            self._keep(box, lower_bound)
        self.status = self.budget.ended_by
        self._report("end")

    def take_lowest(self) -> tuple[float, Box]:
        """Remove the open box with the lowest bound."""
        lower_bound, _, box = heapq.heappop(self.open)
        return lower_bound, box

    def terminate(self) -> None:
        """Update the lower bound, set the status if the search is over, and add an event."""
        budget = self.budget
        lowest_open = self.open[0][0] if self.open else np.inf
        lowest = min(lowest_open, self.pruned_bound, self.upper_bound)
        self.lower_bound = max(self.lower_bound, lowest)
        if self.lower_bound >= self.upper_bound - self.epsilon:
            self.status = Status.OPTIMAL
        elif budget.is_over:
            self.status = budget.ended_by
        else:
            nbytes = len(self.open) * self.bytes_per_box
            self.status = budget.spent(self.n_nodes, self.bound.n_assignments, nbytes)
        self._report("bound" if self.status is None else "end")

    def _report(self, kind: str) -> None:
        """Add an event if there is a new incumbent or a higher lower bound, and at the end."""
        if kind == "bound" and self.events:
            last, rise = self.events[-1], 0.01 * self.epsilon
            if self.upper_bound == last.upper_bound and self.lower_bound < last.lower_bound + rise:
                return
        status = "" if self.status is None else self.status.value
        self.events.append(
            Event(
                kind, self.stage, self.budget.elapsed(), self.n_nodes, self.bound.n_assignments,
                len(self.open), self.lower_bound, self.upper_bound, status,
            )
        )  # fmt: skip


def _bytes_of(box: Box) -> int:
    """Return the memory that an open box takes."""
    return sum(map(sys.getsizeof, (box, box.lower, box.upper, (0.0, 0, box), 0.0, 0)))
