"""Choose the next block: the claim that is expected to be decided in the shortest time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

from baselines import registry
from reports.campaign.forecast import Forecast, Times
from reports.ledger.book import Claim, Ledger, roles_of
from reports.ledger.evidence import methods_in
from reports.ledger.intervals import MIN_INSTANCES, MOST_NEEDED, NOT_RUN, OPEN
from reports.ledger.judging import Judgement
from reports.ledger.verdicts import FEW, WIDE
from reports.theme import words
from workflows.blocks import Needs
from workflows.stages.plan import Plan, PlannedRun, expand

# A step has several blocks if they are expected to take less time: planning, judging and the tables take
# about a minute per step.
STEP_S = 300.0


@dataclass(frozen=True)
class Option:
    """A claim that more blocks may decide.

    Attributes
    ----------
    claim : str
    needs : Needs
        The blocks after its next step, which has one block or several short ones.
    step, block : Forecast
        Of the runs of the next step without a result, and of all runs of the next block.
    blocks : int
        Number of further blocks that are expected to decide the claim.
    obstacle : str
        Why more blocks do not help.
    """

    claim: str
    needs: Needs
    step: Forecast
    block: Forecast
    blocks: int
    obstacle: str = ""

    @property
    def seconds(self) -> float:
        """The expected time until the claim is decided."""
        return self.blocks * self.block.seconds


def options(
    book: Ledger,
    judged: Sequence[Judgement],
    plan: Plan,
    times: Times,
    trials: int,
    done: Set[str] = frozenset(),
) -> list[Option]:
    """Return the open claims about an experiment, the one expected to be decided first at the front.

    `plan` has the needs so far; `trials` is the number of trials of the experiment's config. Runs in
    `done` take no more time, such as those of a pilot.
    """
    claims = {claim.id: claim for claim in book.claims}
    found = [
        _option(book, claims[each.id], each, plan, times, trials, done)
        for each in judged
        if each.verdict in (OPEN, NOT_RUN)
    ]
    return sorted(found, key=lambda option: (bool(option.obstacle), option.seconds, option.claim))


def _option(
    book: Ledger,
    claim: Claim,
    found: Judgement,
    plan: Plan,
    times: Times,
    trials: int,
    done: Set[str],
) -> Option:
    assert plan.needs is not None
    tests = _methods_of_tests(book, claim, plan)
    earlier = {run.run_id for run in plan.runs()}

    def ahead(blocks: int) -> tuple[Needs, list[PlannedRun]]:
        needs = plan.needs or Needs({})
        for test, methods in tests.items():
            for _ in range(blocks):
                needs = needs.with_block(test, methods)
        runs = expand(plan.experiment, plan.selection, plan.config, needs).runs()
        return needs, [run for run in runs if run.run_id not in earlier]

    needs, runs = ahead(1)
    block = times.of_runs(runs)
    done_of = {
        words(test): (plan.needs or Needs({})).of_all(test, methods)
        for test, methods in tests.items()
    }
    blocks, obstacle = _blocks(found, done_of)
    left = trials - min(done_of.values(), default=0)
    at_once = min(blocks, left, int(STEP_S // max(block.seconds, 1.0)))
    if at_once > 1 and not obstacle:
        needs, runs = ahead(at_once)
    step = times.of_runs(run for run in runs if run.run_id not in done)
    if not tests:
        obstacle = "the experiment has none of the methods that the claim compares"
    elif left <= 0:
        obstacle = f"all {trials} trials are run"
    return Option(claim.id, needs, step, block, blocks, obstacle)


def _blocks(found: Judgement, done_of: Mapping[str, int]) -> tuple[int, str]:
    """Return the expected number of further blocks, and why they do not help.

    `done_of` has the blocks of each test, by its words.
    """
    open_ones = [
        each
        for row in found.rows
        for each in row.decided
        if each.verdict == OPEN and not row.shown_only
    ]
    if not open_ones:  # no run yet, or something is missing
        return 1, ""
    lacking = [each for each in open_ones if each.why in (FEW, WIDE)]
    if not lacking:
        return 1, open_ones[0].why
    counts = []
    for each in lacking:
        n, needed = each.part.estimate.n, each.needed
        target = MIN_INSTANCES if needed is None else needed
        done = max(1, done_of.get(each.part.group) or max(done_of.values(), default=0))
        counts.append(math.ceil(done * target / max(n, 1)) - done)
    most = max(counts)
    if any(each.needed == MOST_NEEDED for each in lacking):
        return max(1, most), f"an effect so small that it needs more than {MOST_NEEDED} instances"
    return max(1, most), ""


def _methods_of_tests(book: Ledger, claim: Claim, plan: Plan) -> dict[str, list[str]]:
    """Return the methods that the judged checks of a claim compare, by test."""
    tests = list(dict.fromkeys(test for entry in plan.experiment.datasets for test in entry.tests))
    settings = [
        (method.name, method.baseline, registry.effective_options(method.baseline, method.options),
         method.n_inliers_ratio)
        for method in plan.methods
    ]  # fmt: skip
    found: dict[str, list[str]] = {}
    for check in claim.checks:
        if check.get("shown_only"):
            continue
        names = [
            name for role in roles_of(check) for name in methods_in(book.roles[role], settings)
        ]
        for test in check.get("tests", tests) if names else ():
            if test in tests:
                found[test] = list(dict.fromkeys([*found.get(test, []), *names]))
    return found
