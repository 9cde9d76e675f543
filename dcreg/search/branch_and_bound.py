"""Best-first branch and bound: Algorithm 1 of the DC-Reg paper, in rounds. Knows no geometry.

A bound maps boxes to lower bounds and offers parameters whose objective is known. Each round takes
the best open boxes, divides them, bounds the children and prunes those that cannot improve the
incumbent by more than ``gap_tol``. A round's size is fixed by the problem and its boxes are
independent, so the result does not depend on how many threads evaluate them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dcreg.search.bound import Bound
from dcreg.search.budget import Budget
from dcreg.search.leaves import Leaves
from dcreg.search.nodes import OpenNodes
from dcreg.search.outcome import Outcome
from dcreg.search.trace import Event
from dcreg.status import Status

# A descent starts where the round's best value is no worse than the last start's times this factor per
# round since: often while the search finds better and better places, seldom when it only closes the gap.
REFINING_PATIENCE = 1.01

MIN_ROUND = 16  # boxes a round divides at least, if the search allows as many

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
    start: tuple[np.ndarray, float] | None = None,
    stage: str = "search",
    leaves: Leaves | None = None,
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
        Divides B boxes into 2 B.
    gap_tol : float
        Stop when ``upper_bound - lower_bound <= gap_tol`` (the paper's epsilon).
    refine : callable, optional
        Local descent, tried from the most promising parameter of each round.
    start : (theta, value), optional
        A known admissible parameter and its objective: the first incumbent.
    stage : str
        Name of this search in its events.
    leaves : Leaves, optional
        Collects the leaf boxes with their bounds, for a certificate.

    Returns
    -------
    Outcome
        ``lower_bound <= min <= upper_bound`` whatever the status.
    """
    roots = bound.roots
    began = budget.elapsed()
    theta, upper_bound = start if start is not None else (roots[0].centre, np.inf)
    nodes = OpenNodes(roots[0].dim)
    pruned_bound = np.inf  # least bound among pruned boxes: part of the certificate
    n_nodes = n_refining = 0
    events: list[Event] = []
    status: Status | None = None

    def lower_bound() -> float:
        return min(nodes.lower_bound, pruned_bound, upper_bound)

    def report(kind: str) -> None:
        event = Event(
            kind,
            stage,
            budget.elapsed(),
            n_nodes,
            bound.n_assignments + n_refining,
            len(nodes),
            lower_bound(),
            upper_bound,
            status.value if status is not None else "",
        )
        if kind == "bound" and events and _same_bounds(events[-1], event):
            budget.tell(replace(event, kind="tick"))  # told to the listener, not kept
        else:
            events.append(event)
            budget.tell(event)

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
        over = budget.is_over
        if refine is not None and not over and found.values[best] <= worth_refining:
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
        elif over:
            status = Status.STOPPED if budget.stopped else Status.TIME_LIMIT
        elif budget.nodes is not None and n_nodes >= budget.nodes:
            status = Status.NODE_LIMIT
        elif budget.memory_mb is not None and nodes.nbytes > budget.memory_mb * 2**20:
            status = Status.MEMORY_LIMIT
        report("bound" if status is None else "end")
        if budget.stopped and status is None:
            status = Status.STOPPED
            report("end")
        if status is None:
            # branch
            count = _round(bound.round_size, len(nodes))
            lower, upper, inherited = nodes.pop(count, upper_bound - gap_tol)
            lower, upper = branching(lower, upper)
            inherited = np.repeat(inherited, 2)
    final_bound = lower_bound()
    if leaves is not None and len(nodes):
        leaves.add(*nodes.pop(len(nodes), np.inf), is_open=status is not Status.OPTIMAL)
    return Outcome(
        status,
        theta,
        final_bound,
        upper_bound,
        n_nodes,
        bound.n_assignments + n_refining,
        budget.elapsed() - began,
        events,
    )


def _round(most: int, n_open: int) -> int:
    """How many of the open boxes to divide next."""
    return min(most, max(MIN_ROUND, n_open // 4))


def _settled(values: np.ndarray, gap_tol: float) -> np.ndarray:
    """The values lowered to a grid far below the tolerance.

    Boxes that share a vertex often have equal bounds up to rounding. On the grid they are equal, so that
    the order of the search, and with it all counters, does not hang on the last bits of a machine.
    """
    step = 1e-6 * gap_tol
    return step * (np.round(values / step) - 1.0) if step > 0.0 else values


def _same_bounds(a: Event, b: Event) -> bool:
    return a.lower_bound == b.lower_bound and a.upper_bound == b.upper_bound
