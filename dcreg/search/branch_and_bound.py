"""Best-first branch and bound: Algorithm 1 of the DC-Reg paper, in rounds, without geometry.

A bound maps boxes to lower bounds and offers candidate parameters with their objective. Each round
divides the best open boxes, bounds the children and prunes those that cannot improve the incumbent by
more than the tolerance. The size of a round does not depend on the number of threads, and the boxes of a
round are independent. The result therefore does not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dcreg.search.boxes import Bound, Boxes, Confined, Evaluation, Leaves, OpenNodes
from dcreg.search.budget import Budget, Event, Interrupted
from dcreg.search.outcome import Outcome, Start
from dcreg.search.prospect import (
    ESTIMATED_AFTER_S,
    ESTIMATED_FOR_LISTENER_AFTER_S,
    FEW_DESCENTS,
    Prospect,
)
from dcreg.search.recording import active
from dcreg.search.tolerance import Tolerance
from dcreg.status import Status

# A local search starts from the best candidate of a round if its value is at most that from which the
# last local search started, or `Search.worth_at_most` if lower, times this factor for every round since
# then. Local searches are therefore frequent while the incumbent improves.
REFINING_PATIENCE = 1.01

SHARE_BEFORE_ESTIMATE = 0.2  # share of the patience that may pass before the prospect is estimated
_GRID = 1e-6  # step of rounded values, as a share of the allowed gap
MIN_ROUND = 16  # minimum number of boxes divided in a round, if the bound allows it


# theta -> (better theta, its objective, assignments spent): local search from a promising parameter
Refine = Callable[[np.ndarray], tuple[np.ndarray, float, int]]
Branching = Callable[[Boxes], Boxes]


def branch_and_bound(
    bound: Bound,
    budget: Budget,
    *,
    branching: Branching,
    tolerance: Tolerance,
    refine: Refine | None = None,
    start: Sequence[Any] | None = None,
    stage: str = "search",
    keep_leaves: bool = False,
) -> Outcome:
    """Minimise a function over boxes to within a tolerance, by Algorithm 1 of DC-Reg.

    Parameters
    ----------
    bound : Bound
        Bounds a non-negative function; ``bound.roots`` are searched. A round divides a share of the open
        boxes, at most ``bound.round_size``. The search therefore stays close to best-first while few
        boxes are open.
    budget : Budget
        Its listener receives an event for every round; the search ends when the budget is spent. If it
        has a patience, the search ends as ``converged`` when the patience is over, or when the proof is
        expected to take much longer.
    branching : callable
        From boxes to their children, which inherit bounds and warm starts.
    tolerance : Tolerance
        The gap at which to stop; ``Tolerance(abs=epsilon)`` is the paper's epsilon.
    refine : callable, optional
        Local search from the best candidate of a round.
    start : Start or (theta, value), optional
        The first incumbent: an admissible parameter and its objective.
    stage : str
        Name of this search in its events.
    keep_leaves : bool
        Keep the leaf boxes with their bounds, for a certificate.

    Returns
    -------
    Outcome
        ``lower_bound <= minimum <= upper_bound`` for every status.
    """
    search = Search(
        bound, budget, branching, tolerance, stage, refine,
        Start(bound.roots[0].centre) if start is None else Start(*start),
        Leaves() if keep_leaves else None, Confined(Boxes.of(bound.roots), np.inf),
    )  # fmt: skip
    search.run()
    return search.outcome()


@dataclass
class Search:
    """The state of one search; its methods are the steps of Algorithm 1.

    Most parameters are those of `branch_and_bound`.

    Attributes
    ----------
    floor : float
        A lower bound on the minimum from an earlier part of the search.
    """

    bound: Bound
    budget: Budget
    branching: Branching
    tolerance: Tolerance
    stage: str
    refine: Refine | None
    start: Start
    leaves: Leaves | None
    confined: Confined
    floor: float = 0.0
    n_nodes_before: int = 0  # of `n_nodes`, boxes that do not count for the prospect
    # boxes bounded before the prospect is estimated, if they take little time
    n_before_estimate: int = 0
    is_part: bool = False  # of a search that goes on afterwards
    not_bounding_s: float = 0.0  # since `patience_began`: seconds of local searches and estimates
    prospect: Prospect | None = None
    region: Confined | None = None
    n_nodes: int = 0
    n_refining: int = 0
    worth_refining: float = np.inf
    # objective of the incumbent -> value up to which a local search pays
    worth_at_most: Callable[[float], float] = field(default=lambda value: np.inf)
    is_over: bool = False
    status: Status | None = None
    events: list[Event] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.theta, self.upper_bound = self.start.theta, self.start.value
        # each part of a search has the whole patience
        self.began = self.patience_began = self.budget.elapsed()
        self.nodes = OpenNodes(self.bound.roots[0].dim)
        # minimum over the pruned boxes: part of the certificate
        self.pruned_bound = self.confined.outside
        self.boxes = self.confined.boxes  # to be bounded next; until then, 0 is their valid bound

    def run(self, pause: float = np.inf) -> None:
        """Search until a status is set, or until `pause` boxes are bounded."""
        if not len(self.boxes) and self.status is None:
            self.terminate()
        while self.status is None and self.n_nodes < pause:
            boxes, self.boxes = self.boxes, self.boxes[:0]
            if len(boxes):
                try:
                    found = self.bound.evaluate(boxes, self.cutoff)
                except Interrupted:
                    self.put_back(boxes)
                    break
                self.update_incumbent(found)
                self.prune(boxes, found)
            self.terminate()
            if self.status is None:
                self.boxes = self.within_region(self.branching(self.select()))

    @property
    def cutoff(self) -> float:
        """Lower bound from which a box cannot improve the incumbent by more than the tolerance."""
        return self.tolerance.cutoff(self.upper_bound)

    @property
    def lower_bound(self) -> float:
        pending = float(self.boxes.bounds.min(initial=np.inf))  # boxes of a paused search
        proven = min(self.nodes.lower_bound, pending, self.pruned_bound, self.upper_bound)
        return min(max(proven, self.floor), self.upper_bound)

    @property
    def n_assignments(self) -> int:
        return self.bound.n_assignments + self.n_refining

    def confined_to(self, confined: Confined, tolerance: Tolerance) -> Search:
        """Return a search of the `confined` boxes that continues the counts of this one."""
        start = self.start._replace(theta=self.theta, value=self.upper_bound)
        return replace(
            self, tolerance=tolerance, start=start, confined=confined, prospect=None,
            n_nodes_before=self.n_nodes, events=[], is_part=True, not_bounding_s=0.0,
        )  # fmt: skip

    def narrow(self, confined: Confined) -> None:
        """Continue with only the boxes that meet the `confined` ones, and with a new patience."""
        if recorder := active():
            recorder.confine(self.stage, confined)
        self.region = confined
        self.pruned_bound = min(self.pruned_bound, confined.outside)
        self.boxes = self.within_region(self.boxes)
        self.nodes.push(self.within_region(self.nodes.pop(len(self.nodes), np.inf)))
        self.prospect, self.n_nodes_before = None, self.n_nodes
        self.patience_began, self.not_bounding_s = self.budget.elapsed(), 0.0

    def within_region(self, boxes: Boxes) -> Boxes:
        """Return the boxes that may contain an optimum below the cutoff, if the search was narrowed."""
        return boxes if self.region is None else self.region.meeting(boxes)

    def take_over(self, part: Search) -> None:
        """Adopt the counts, the incumbent and the lower bound of a part, which has ended."""
        self.take(part.theta, part.upper_bound)
        self.n_nodes_before += part.n_nodes - self.n_nodes
        self.n_nodes, self.n_refining = part.n_nodes, part.n_refining
        self.floor = max(self.floor, part.lower_bound)
        self.events += part.events

    def resume(self, paused_at: float) -> None:
        """Do not count the time since `paused_at` towards the patience of this search."""
        self.patience_began += self.budget.elapsed() - paused_at

    def update_incumbent(self, found: Evaluation) -> None:
        """Update the incumbent by the best candidate of the round and a local search from it."""
        best = int(np.argmin(self._settled(found.values)))
        value = float(found.values[best])
        self.take(found.thetas[best], value)
        self.is_over = self.budget.is_over
        # none begins while local searches have solved more assignments than bounds
        is_cheap = self.n_refining <= self.bound.n_assignments
        if self.refine and is_cheap and not self.is_over and value <= self.worth_refining:
            self.worth_refining = min(value, self.worth_at_most(self.upper_bound))
            began = self.budget.elapsed()
            try:
                theta, value, spent = self.refine(found.thetas[best])
            except Interrupted:
                self.is_over = True
                return
            self.not_bounding_s += self.budget.elapsed() - began
            self.n_refining += spent
            self.take(theta, value)
        self.worth_refining *= REFINING_PATIENCE

    def take(self, theta: np.ndarray, value: float) -> None:
        if value < self.upper_bound:
            self.theta, self.upper_bound = theta.copy(), value

    def prune(self, boxes: Boxes, found: Evaluation) -> None:
        """Keep the boxes that may contain a better parameter. A bound is at least that of the parent."""
        bounds = np.maximum(self._settled(found.lower_bounds), boxes.bounds)
        boxes = Boxes(boxes.lower, boxes.upper, bounds, found.warm_start)
        self.n_nodes += len(bounds)
        keep = bounds < self.cutoff
        if not keep.all():
            self.pruned_bound = min(self.pruned_bound, float(bounds[~keep].min()))
            if self.leaves is not None:
                self.leaves.add(boxes[~keep])
        self.nodes.push(boxes[keep])
        if recorder := active():
            recorder.add(self.stage, boxes, keep, (self.lower_bound, self.upper_bound, self.theta))

    def put_back(self, boxes: Boxes) -> None:
        """End the search with boxes that could not be bounded in time."""
        self.nodes.push(boxes)
        self.is_over = True
        self.terminate()

    def terminate(self) -> None:
        """Set the status if the search is over, and report the round."""
        budget = self.budget
        self.status = self.tolerance.status(self.lower_bound, self.upper_bound)
        if self.status is None and self.is_over:
            self.status = budget.ended_by
        elif self.status is None:
            self.status = budget.spent(
                self.n_nodes, self.n_assignments + self.start.n_assignments, self.nodes.nbytes
            )
        if self.status is None and self._has_no_prospect():
            self.status = Status.CONVERGED
        self._report("bound" if self.status is None else "end")
        if budget.stopped and self.status is None:
            self.status = Status.STOPPED
            self._report("end")

    def _has_no_prospect(self) -> bool:
        """Tell whether the patience is over, or the proof is expected to exceed it by far."""
        budget = self.budget
        spent, done = budget.elapsed() - self.patience_began, self.n_nodes - self.n_nodes_before
        if budget.patience_s is not None and spent >= budget.patience_s:
            at = done, spent, budget, self.not_bounding_s
            return self.prospect is None or not self.prospect.is_near(*at)
        if self._is_before_estimate(spent):
            return False
        asked_after_s = (
            ESTIMATED_FOR_LISTENER_AFTER_S if budget.patience_s is None else ESTIMATED_AFTER_S
        )
        if spent < asked_after_s or not (budget.patience_s is not None or budget.is_watched):
            return False
        if not done:
            return False
        if self.prospect is None:
            if Prospect(done + FEW_DESCENTS).is_poor(done, spent, budget, self.not_bounding_s):
                return True  # even the estimate would take too long
            self.estimate()
            spent = budget.elapsed() - self.patience_began
        assert self.prospect is not None
        return self.prospect.is_poor(done, spent, budget, self.not_bounding_s)

    def estimate(self) -> float:
        """Estimate how many boxes the proof takes; return how many of them are left."""
        began, boxes = self.budget.elapsed(), Boxes.joined(self.nodes.boxes(), self.boxes)
        done = self.n_nodes - self.n_nodes_before
        if not len(boxes):
            self.prospect = Prospect(done)
            return 0.0
        spent_s = began - self.patience_began
        # unknown before the first box after a checkpoint
        box_s = (spent_s - self.not_bounding_s) / done if done else 0.0
        found = Prospect.of(
            self.bound.fresh(), self.branching, self.cutoff, boxes, self.within_region, self.budget,
            spent_s, box_s,
        )  # fmt: skip
        self.prospect = replace(found, n_nodes=done + found.n_nodes)
        self.not_bounding_s += self.budget.elapsed() - began
        return found.n_nodes

    def _is_before_estimate(self, spent_s: float) -> bool:
        """Tell whether `n_before_estimate` boxes will be bounded soon, and the estimate can wait."""
        patience_s = self.budget.patience_s
        if patience_s is None or self.n_nodes >= self.n_before_estimate:
            return False
        return spent_s * self.n_before_estimate < SHARE_BEFORE_ESTIMATE * patience_s * self.n_nodes

    def _expected_s(self) -> float | None:
        """Return the estimated seconds until the proof, as in `Event`."""
        if self.prospect is None or self.status is not None:
            return None
        return self.prospect.expected_s(
            self.n_nodes - self.n_nodes_before, self.budget.elapsed() - self.patience_began, self.budget,
            self.not_bounding_s,
        )  # fmt: skip

    def select(self) -> Boxes:
        """Return the best open boxes, which are divided next."""
        count = min(self.bound.round_size, max(MIN_ROUND, len(self.nodes) // 4))
        return self.nodes.pop(count, self.cutoff)

    def outcome(self) -> Outcome:
        """Return the outcome; the search cannot be continued afterwards."""
        lower_bound = self.lower_bound
        if self.leaves is not None and len(self.nodes):
            is_open = lower_bound < self.cutoff
            self.leaves.add(self.nodes.pop(len(self.nodes), np.inf), is_open)
        assert self.status is not None
        spent = self.n_assignments + self.start.n_assignments
        return Outcome(
            self.status, self.theta, lower_bound, self.upper_bound, self.n_nodes, spent,
            self.start.time_s + self.budget.elapsed() - self.began, self.events, self.leaves,
        )  # fmt: skip

    def _settled(self, values: np.ndarray) -> np.ndarray:
        """Return the values rounded down to a grid much finer than the allowed gap.

        Boxes that share a vertex often have bounds that are equal up to rounding. On the grid they are
        equal, so the order of the search and all counters do not depend on the last bits.
        """
        step = _GRID * self.tolerance.allowed(self.upper_bound)
        return step * (np.round(values / step) - 1.0) if step > 0.0 else values

    def _report(self, kind: str) -> None:
        status = "" if self.status is None or self.is_part else self.status.value
        event = Event(
            "bound" if self.is_part else kind, self.stage, self.budget.elapsed(), self.n_nodes,
            self.n_assignments, 0 if status == Status.OPTIMAL else len(self.nodes),
            self.lower_bound, self.upper_bound, status, self._expected_s(),
        )  # fmt: skip
        if kind == "bound" and self.events and _same_bounds(self.events[-1], event):
            event = replace(event, kind="heartbeat")  # passed to the listener, not kept
        else:
            self.events.append(event)
        self.budget.report(event)


def _same_bounds(a: Event, b: Event) -> bool:
    return a.lower_bound == b.lower_bound and a.upper_bound == b.upper_bound
