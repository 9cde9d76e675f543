"""Best-first branch and bound: Algorithm 1 of the DC-Reg paper, in rounds. Knows no geometry.

A bound maps boxes to lower bounds and offers parameters whose objective is known. Each round takes
the best open boxes, divides them, bounds the children and prunes those that cannot improve the
incumbent by more than ``gap_tol``. A round's size is fixed by the problem and its boxes are
independent, so the result does not depend on how many threads evaluate them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from dcreg.box import Box
from dcreg.nodes import OpenNodes
from dcreg.result import Status
from dcreg.trace import Event, Listener


@dataclass
class Evaluation:
    """What a bound says of B boxes.

    Attributes
    ----------
    lower_bounds : (B,) array
        Valid for every admissible theta of the box; +inf when the box holds none.
    thetas : (B, d) array
        One parameter per box worth knowing, admissible or not.
    values : (B,) array
        Upper bounds on the objective at `thetas`; +inf where theta is not admissible.
    """

    lower_bounds: np.ndarray
    thetas: np.ndarray
    values: np.ndarray


class Bound(Protocol):
    """A lower bounding function: the part that the paper's comparison exchanges."""

    @property
    def n_assignments(self) -> int: ...

    def evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        """Bound B boxes (rows of `lower`, `upper`); above `cutoff` precision is of no use."""
        ...


# A descent starts from a value no worse than the last start's, growing by this factor a round: often
# while the search finds better and better places, seldom when it only closes the gap.
REFINING_PATIENCE = 1.01

FEWEST = 16  # boxes a round divides, if the search allows as many

# theta -> (better theta, its objective, assignments spent): descent from a promising parameter
Refine = Callable[[np.ndarray], tuple[np.ndarray, float, int]]
Branching = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Limits:
    """Where a search must stop; its bounds stay valid. None: no limit."""

    time_s: float | None = None
    nodes: int | None = None
    memory_mb: float | None = None


class Leaves:
    """The undivided boxes at the end of a search: together they cover the roots exactly.

    ``reason`` is PRUNED (bound at least upper_bound - gap_tol), EMPTY (no admissible parameter) or
    OPEN (a limit came first).
    """

    PRUNED, EMPTY, OPEN = 0, 1, 2

    def __init__(self) -> None:
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def add(
        self, lower: np.ndarray, upper: np.ndarray, bounds: np.ndarray, is_open: bool = False
    ) -> None:
        reason = np.where(np.isinf(bounds), self.EMPTY, self.OPEN if is_open else self.PRUNED)
        self._parts.append((lower.copy(), upper.copy(), bounds.copy(), reason.astype(np.int8)))

    def arrays(self) -> dict[str, np.ndarray]:
        """``lower`` (L, d), ``upper`` (L, d), ``bounds`` (L,) and ``reason`` (L,)."""
        names = ("lower", "upper", "bounds", "reason")
        return dict(zip(names, map(np.concatenate, zip(*self._parts, strict=True)), strict=True))


@dataclass
class SearchResult:
    status: Status
    theta: np.ndarray
    lower_bound: float
    upper_bound: float
    n_nodes: int
    n_assignments: int
    time_s: float
    events: list[Event] = field(default_factory=list)


def branch_and_bound(
    bound: Bound,
    roots: list[Box],
    *,
    branching: Branching,
    gap_tol: float,
    refine: Refine | None = None,
    start: tuple[np.ndarray, float] | None = None,
    limits: Limits | None = None,
    round_size: int = 16,
    listener: Listener | None = None,
    stage: str = "search",
    leaves: Leaves | None = None,
) -> SearchResult:
    """Minimise a function over boxes to within `gap_tol`, by Algorithm 1 of DC-Reg.

    Parameters
    ----------
    bound : Bound
        The function is known through it alone. It must be non-negative.
    roots : list of Box
        Together they hold the region searched.
    branching : callable
        Divides B boxes into 2 B.
    gap_tol : float
        Stop when ``upper_bound - lower_bound <= gap_tol`` (the paper's epsilon).
    refine : callable, optional
        Local descent, tried from the most promising parameter of each round.
    start : (theta, value), optional
        A known admissible parameter and its objective: the first incumbent.
    limits : Limits, optional
    round_size : int
        Most open boxes divided per round. A round takes a share of those there are: while few are open,
        the next ones are chosen with care.
    listener : callable, optional
        Receives an `Event` whenever a bound moved; returning True stops the search.
    leaves : Leaves, optional
        Collects the leaf boxes with their bounds, for a certificate.

    Returns
    -------
    SearchResult
        ``lower_bound <= min <= upper_bound`` whatever the status.
    """
    limits = limits or Limits()
    clock = time.perf_counter
    began = clock()
    theta, upper_bound = start if start is not None else (roots[0].centre, np.inf)
    nodes = OpenNodes(roots[0].dim)
    pruned_bound = np.inf  # least bound among pruned boxes: part of the certificate
    n_nodes = n_refining = 0
    events: list[Event] = []
    status: Status | None = None

    def lower_bound() -> float:
        return min(nodes.lower_bound, pruned_bound, upper_bound)

    def report(kind: str) -> bool:
        event = Event(
            kind,
            stage,
            clock() - began,
            n_nodes,
            bound.n_assignments + n_refining,
            len(nodes),
            lower_bound(),
            upper_bound,
            status.value if status is not None else "",
        )
        if kind == "bound" and events and _same_bounds(events[-1], event):
            kind = "tick"  # told to the listener, not kept
        else:
            events.append(event)
        return bool(listener(event)) if listener is not None else False

    lower = np.array([box.lower for box in roots])
    upper = np.array([box.upper for box in roots])
    inherited = np.zeros(len(roots))  # the objective is a sum of squares
    worth_refining = np.inf
    while status is None:
        # bound
        found = bound.evaluate(lower, upper, upper_bound - gap_tol)
        bounds = np.maximum(_settled(found.lower_bounds, gap_tol), inherited)
        n_nodes += len(bounds)
        # update
        best = int(np.argmin(_settled(found.values, gap_tol)))
        if found.values[best] < upper_bound:
            theta, upper_bound = found.thetas[best].copy(), float(found.values[best])
        late = limits.time_s is not None and clock() - began > limits.time_s
        if refine is not None and not late and found.values[best] <= worth_refining:
            worth_refining = float(found.values[best])
            candidate, value, spent = refine(found.thetas[best])
            n_refining += spent
            if value < upper_bound:
                theta, upper_bound = candidate, value
        worth_refining *= REFINING_PATIENCE
        # prune
        keep = bounds < upper_bound - gap_tol
        if not keep.all():
            pruned_bound = min(pruned_bound, float(bounds[~keep].min()))
            if leaves is not None:
                leaves.add(lower[~keep], upper[~keep], bounds[~keep])
        nodes.push(lower[keep], upper[keep], bounds[keep])
        # terminate
        if lower_bound() >= upper_bound - gap_tol:
            status = Status.OPTIMAL
        elif late:
            status = Status.TIME_LIMIT
        elif limits.nodes is not None and n_nodes >= limits.nodes:
            status = Status.NODE_LIMIT
        elif limits.memory_mb is not None and nodes.nbytes > limits.memory_mb * 2**20:
            status = Status.MEMORY_LIMIT
        if report("bound" if status is None else "end") and status is None:
            status = Status.STOPPED
            report("end")
        if status is None:
            # branch
            lower, upper, inherited = nodes.pop(
                _share(round_size, len(nodes)), upper_bound - gap_tol
            )
            lower, upper = branching(lower, upper)
            inherited = np.repeat(inherited, 2)
    final_bound = lower_bound()
    if leaves is not None and len(nodes):
        leaves.add(*nodes.pop(len(nodes), np.inf), is_open=status is not Status.OPTIMAL)
    return SearchResult(
        status,
        theta,
        final_bound,
        upper_bound,
        n_nodes,
        bound.n_assignments + n_refining,
        clock() - began,
        events,
    )


def _share(most: int, n_open: int) -> int:
    return min(most, max(FEWEST, n_open // 4))


def _settled(values: np.ndarray, gap_tol: float) -> np.ndarray:
    """The values lowered to a grid far below the tolerance.

    Boxes that share a vertex often have equal bounds up to rounding. On the grid they are equal, so that
    the order of the search, and with it all counters, does not hang on the last bits of a machine.
    """
    step = 1e-6 * gap_tol
    return step * (np.round(values / step) - 1.0) if step > 0.0 else values


def _same_bounds(a: Event, b: Event) -> bool:
    return a.lower_bound == b.lower_bound and a.upper_bound == b.upper_bound
