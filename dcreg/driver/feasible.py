"""The stage before a search that compares the distances within feasible pairs."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from dcreg.assignment.consistency import refutes
from dcreg.driver.normalised import NormalisedProblem
from dcreg.search import Budget, Event, Interrupted, Outcome
from dcreg.status import Status

FEASIBLE = "feasible pairs"  # the stage
MAX_FEASIBLE = 1000  # pairs up to which it runs
REFUTING_SHARE = 0.5  # of the time, at most


def refuted_at_once(space: Any, problem: NormalisedProblem, budget: Budget) -> Outcome | None:
    """Return the outcome if the distances within few feasible pairs prove that no pose meets the target.

    Its pose is the end of a single local search.
    """
    tolerance, candidates, began = problem.tolerance, problem.candidates, budget.elapsed()
    if tolerance.target is None or candidates is None or problem.keep_leaves:
        return None
    if np.count_nonzero(candidates) > MAX_FEASIBLE:
        return None
    lower_bound = tolerance.cutoff(np.inf)
    if not refutes(
        problem.source, problem.target, candidates, problem.n_inliers, problem.scale_range,
        lower_bound, budget.sub_budget(REFUTING_SHARE),
    ):  # fmt: skip
        return None
    value = np.inf
    try:
        theta, spent = next(space.starts(budget))
    except Interrupted:
        theta, spent = space.seeds()[0], 0
    with suppress(Interrupted):
        refined, value, n_more = space.refine(theta)
        spent += n_more
        theta = refined if np.isfinite(value) else theta
    now = budget.elapsed()
    event = Event("end", FEASIBLE, now, 0, spent, 0, lower_bound, value, Status.REFUTED.value)
    budget.report(event)
    return Outcome(Status.REFUTED, theta, lower_bound, value, 0, spent, now - began, events=[event])
