"""Minimise over a space by local searches, then by branch and bound, which a cover can confine.

A *cover* is a small set of boxes that contains every optimum with an objective below some value. The
stages ``triples`` (3D) and ``distances`` (2D) of a result are covers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from dcreg.search.boxes import Bound, Boxes, Confined, Leaves, LongestEdge
from dcreg.search.branch_and_bound import Search
from dcreg.search.budget import Budget, Event, Interrupted
from dcreg.search.outcome import Outcome, Start
from dcreg.search.tolerance import Tolerance
from dcreg.status import Status

UNSURE = 5.0  # factor of the patience if the initial poses are not confirmed
SHORT = 2048  # boxes bounded before a cover is tried
COVER_SHARE = 0.8  # share of the time left that one call of `Cover.confine` may take
UNLIMITED_S = 120.0  # time left that is assumed without a limit, and at most
# Nominal seconds (see `Cover.confine`) of a call if boxes or assignments are limited.
COUNTED_S = 5.0
# One call may take WORTH of the nominal seconds that boxes alone are expected to take. If boxes prove the
# whole cutoff in time, a smaller share may take only PREVIEW: all that it raises is the lower bound until
# then.
WORTH, PREVIEW = 0.4, 0.05


class Searchable(Protocol):
    """What a search needs from a parameter space."""

    axis_weights: np.ndarray
    is_confirmed: bool  # whether independent initial poses agree on the first incumbent
    ends: Sequence[tuple[np.ndarray, float]]  # where local searches ended, with the objective

    def start(
        self, budget: Budget, enough: float = 0.0, known: float = np.inf
    ) -> tuple[np.ndarray, float, int]:
        """Return a first incumbent: theta, objective, assignments spent.

        `enough` is good enough, and values of at least `known` are not reported.
        """
        ...

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Search locally from `theta`; return a better theta, its objective, assignments spent."""
        ...

    def worth_refining(self, value: float) -> float:
        """Return the objective up to which a local search from a box pays; `value` is known."""
        ...


class Cover(Protocol):
    """Finds few boxes that contain every optimum with an objective below a value.

    Attributes
    ----------
    stage : str
        Name in events and results.
    threads : int
    proven : (float, float)
        The last cutoff proven, and its nominal seconds, from which those of the next one are
        extrapolated; zeros at first.
    """

    stage: str
    threads: int
    proven: tuple[float, float]

    @property
    def shares(self) -> Sequence[float]:
        """Shares of the cutoff to prove, in this order. Those after 1 are for searches without an end."""
        ...

    @property
    def box_s(self) -> float:
        """Nominal seconds (see `confine`) of the search per box."""
        ...

    @property
    def applies(self) -> bool:
        """Whether the cover may help if the search is long."""
        ...

    @property
    def is_compiled(self) -> bool:
        """Whether nothing remains to be compiled."""
        ...

    def confine(self, cutoff: float, budget: Budget, allowed_s: float) -> Confined | None:
        """Return boxes that contain every optimum with an objective below `cutoff`.

        None if this takes longer than `allowed_s` or leaves too many boxes. `allowed_s` are nominal CPU
        seconds of all threads together: computed from the amount of work by fixed rates, so that they are
        equal on all machines.
        """
        ...


def minimise(
    space: Searchable,
    bound: Bound,
    budget: Budget,
    *,
    tolerance: Tolerance,
    start: Sequence[Any] | None = None,
    make_cover: Callable[[], Cover] | None = None,
    stage: str = "search",
    keep_leaves: bool = False,
) -> Outcome:
    """Minimise the objective of a space over the roots of `bound`, to within a tolerance.

    Parameters
    ----------
    space : Searchable
        Provides the first incumbent, the local searches, and the weights for dividing boxes.
    bound : Bound
    budget : Budget
        Its patience applies if the initial poses are confirmed. If they are not, the search may find a
        better incumbent: a finite patience is then `UNSURE` times as long, and inf is ignored.
    tolerance : Tolerance
        In the units of the objective.
    start : (theta, value), optional
        A known parameter and its objective; default: the result of ``space.start``.
    make_cover : callable, optional
        Returns the `Cover` that confines a long search to few boxes.
    stage, keep_leaves
        See `branch_and_bound`.

    Returns
    -------
    Outcome
    """
    resumed = budget.resumed
    if resumed is not None:
        start = Start(bound.roots[0].centre)  # replaced below
    elif start is None:
        began = budget.elapsed()
        start = space.start(budget, tolerance.enough)
        start = Start(*start, budget.elapsed() - began)
    search = Search(
        bound, budget, LongestEdge(space.axis_weights), tolerance, stage, space.refine,
        Start(*start), Leaves() if keep_leaves else None,
        Confined(Boxes.of(bound.roots), np.inf),
    )  # fmt: skip
    search.worth_at_most = space.worth_refining
    search.worth_refining = space.worth_refining(search.upper_bound)
    course = Course(space, search, is_cut=resumed is None and budget.is_over)
    if resumed is not None:
        resumed.restore(course)
    if not space.is_confirmed:
        search.budget = budget.with_patience(_unsure(budget.patience_s))
    if make_cover is None or keep_leaves:
        course.run(search)
        return search.outcome()
    # before, an estimate is premature, because a cover can change it
    search.n_before_estimate = SHORT
    course.run(search, SHORT)
    cover = make_cover() if search.status is None else None
    if cover is not None and cover.applies:
        return _with_cover(course, cover, budget.patience_s)
    course.run(search)
    return search.outcome()


@dataclass
class Course:
    """How far `minimise` has come: what a checkpoint saves.

    Attributes
    ----------
    space : Searchable
    search : Search
    is_cut : bool
        Whether a limit ended the search for initial poses. It is then repeated, not continued.
    n_shares : int
        Shares of the cutoff that were tried.
    too_large : float
        The smallest share that the cover gave up; above 1 if there is none.
    confined : list of Confined
        What the cover returned.
    abandoned_s : dict of str to float
        As in `Outcome`.
    proven : (float, float)
        That of the cover.
    part : Search, optional
        The search for a share of the cutoff that is in progress.
    """

    space: Searchable
    search: Search
    is_cut: bool = False
    n_shares: int = 0
    too_large: float = 2.0
    confined: list[Confined] = field(default_factory=list)
    abandoned_s: dict[str, float] = field(default_factory=dict)
    proven: tuple[float, float] = (0.0, 0.0)
    part: Search | None = None

    def run(self, search: Search, pause: float = np.inf) -> None:
        """Search until a status is set, or until `pause` boxes are bounded; save checkpoints."""
        checkpoint = search.budget.checkpoint
        if checkpoint is None or self.is_cut:
            search.run(pause)
            return
        while search.status is None and search.n_nodes < pause:
            search.run(min(pause, search.n_nodes + 1))  # one round
            checkpoint.save(self, at_once=search.status is not None)


def _with_cover(course: Course, cover: Cover, patience_s: float | None) -> Outcome:
    """Continue a long search: prove shares of the cutoff by means of a cover, while time allows."""
    search, budget = course.search, course.search.budget
    cover.proven = course.proven
    search_s = 0.0
    if search.status is None and course.n_shares < len(cover.shares):
        # without a time per box, an estimate of the boxes is not needed
        search_s = search.estimate() * cover.box_s if cover.box_s < np.inf else np.inf
    while course.n_shares < len(cover.shares):
        is_soon = search_s <= _allowed_s(search, cover, patience_s)
        if is_soon and 1.0 in cover.shares[: course.n_shares]:
            break  # boxes alone prove the whole cutoff
        share, paused_at = cover.shares[course.n_shares], budget.elapsed()
        tolerance = _share_of(search.tolerance, share)
        is_open = tolerance.cutoff(search.upper_bound) > search.floor
        if course.part is None and is_open and share < course.too_large:
            worth = PREVIEW if is_soon and share < 1.0 else WORTH
            allowed_s = min(_allowed_s(search, cover, patience_s), worth * search_s)
            confined = _confined(search, cover, tolerance.cutoff(search.upper_bound), allowed_s)
            course.proven = cover.proven
            if confined is not None:
                course.confined.append(confined)
                if share == 1.0:
                    # the open boxes share vertices and warm starts with the boxes that are left
                    search.narrow(confined)
                    course.n_shares = len(cover.shares)
                    break
                course.part = search.confined_to(confined, tolerance)
            elif budget.is_over:
                break  # a continued search tries this share again
            else:
                course.too_large = share
                spent_s = budget.elapsed() - paused_at
                course.abandoned_s[cover.stage] = course.abandoned_s.get(cover.stage, 0.0) + spent_s
                search.resume(paused_at)
        if course.part is not None:
            course.run(course.part)
            search.take_over(course.part)
            search.resume(paused_at)
            if course.part.status is not Status.OPTIMAL:
                search.status = course.part.status
                break
            course.part = None
            search.terminate()
            if search.status is not None:
                break
        course.n_shares += 1
    course.run(search)
    return replace(search.outcome(), confined=course.confined, abandoned_s=course.abandoned_s)


def _allowed_s(search: Search, cover: Cover, patience_s: float | None) -> float:
    """Return the nominal seconds that the limits allow for one call of `Cover.confine`.

    A cover finds no better incumbent, so `patience_s` is that for confirmed initial poses.
    """
    budget = search.budget
    if budget.is_counted:  # neither the clock nor the threads may change the result
        return COUNTED_S
    times = [time_s for time_s in (budget.left(), patience_s) if time_s is not None]
    return COVER_SHARE * min([UNLIMITED_S, *times]) * cover.threads


def _confined(search: Search, cover: Cover, cutoff: float, allowed_s: float) -> Confined | None:
    """Return boxes that contain every optimum below the cutoff; None if this takes too long."""
    budget = search.budget
    budget.report(
        Event(
            "heartbeat", cover.stage, budget.elapsed(), search.n_nodes, search.n_assignments,
            len(search.nodes), search.lower_bound, search.upper_bound,
        )
    )  # fmt: skip
    try:
        return cover.confine(cutoff, budget, allowed_s)
    except Interrupted:
        return None


def _share_of(tolerance: Tolerance, share: float) -> Tolerance:
    """Return the tolerance at which a share of the cutoff is proved; a share of 1 changes no bit."""
    return replace(tolerance, rel=tolerance.rel + (1.0 - share) * (1.0 - tolerance.rel))


def _unsure(patience_s: float | None) -> float | None:
    """Return the patience for a search whose initial poses are not confirmed."""
    return None if patience_s is None or patience_s == np.inf else UNSURE * patience_s
