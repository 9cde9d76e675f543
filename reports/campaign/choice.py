"""Choose the next block. It belongs to the claim with the shortest expected time to a verdict.

Usually, one comparison on the other side refutes a claim, and all must agree to reproduce it. So the
comparisons of a claim are run one after the other: one that is expected to refute it comes first, then
the one with the shortest expected time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property

from reports.campaign.comparisons import Comparison, comparisons
from reports.campaign.forecast import Forecast, Times
from reports.ledger.book import Claim, Ledger
from reports.ledger.intervals import (
    MIN_SPREAD,
    MOST_NEEDED,
    NOT_RUN,
    OPEN,
    distance,
)
from reports.ledger.judging import Judgement
from reports.ledger.verdicts import FEW, WIDE, Decided
from workflows.blocks import Needs
from workflows.stages.plan import InstanceSpec, Plan, PlannedRun, blocks, expand

# A step joins blocks as long as their expected time is at most this. Planning, judging and the tables
# take up to half a minute per step, and while its last job runs, other cores are idle.
STEP_S = 1200.0
NO_METHODS = "every comparison needs a method that is not installed or not in the experiment"


@dataclass(frozen=True)
class Option:
    """A claim that more blocks may decide.

    Attributes
    ----------
    claim : str
    comparison : Comparison or None
        The one to run next; None if there is none.
    needs : Needs
        The blocks after its next step, which has one block or several short ones.
    step, block : Forecast
        Of the runs of the next step without a result, and of all runs of the next block.
    blocks : int
        Number of further blocks that are expected to decide the comparison.
    seconds : float
        The expected time until the claim is decided.
    obstacle : str
        Why more blocks cannot reproduce the claim, or cannot decide it.
    helps : bool
        Whether more blocks can decide the claim: some open comparison has no obstacle.
    """

    claim: str
    comparison: Comparison | None
    needs: Needs
    step: Forecast
    block: Forecast
    blocks: int
    seconds: float
    obstacle: str = ""
    helps: bool = True

    @property
    def rank(self) -> tuple[bool, bool, float, str]:
        """Sort key: the claim that is expected to be decided first comes first."""
        return not self.helps, bool(self.obstacle), self.seconds, self.claim


@dataclass(frozen=True)
class _Open:
    """An open comparison, and the blocks that are expected to decide it."""

    comparison: Comparison
    block: Forecast
    blocks: int
    obstacle: str
    refutes: bool  # its figure lies on the other side

    @property
    def seconds(self) -> float:
        return self.blocks * self.block.seconds


@dataclass(frozen=True)
class _State:
    """What is known before the next block."""

    plan: Plan
    times: Times
    trials: int
    done: Set[str]

    @property
    def needs(self) -> Needs:
        return self.plan.needs or Needs({})

    @cached_property
    def earlier(self) -> set[str]:
        """The run_ids of all blocks so far."""
        return {run.run_id for run in self.plan.runs()}

    def left(self, comparison: Comparison) -> int:
        """Return how many more blocks of a comparison the experiment has."""
        return max(0, self.trials - comparison.blocks_in(self.needs))

    @cached_property
    def instances(self) -> Mapping[str, Sequence[InstanceSpec]]:
        """All instances of the selection by test."""
        found: dict[str, list[InstanceSpec]] = {}
        for chunk in expand(self.plan.experiment, self.plan.selection, self.plan.config).chunks:
            for instance in chunk.instances:
                found.setdefault(instance.test, []).append(instance)
        return found

    def ahead(self, further: Mapping[Comparison, int]) -> tuple[Needs, list[PlannedRun]]:
        """Return the needs with further blocks of comparisons, and the runs that they add."""
        needs = self.needs
        for comparison, number in further.items():
            needs = needs.joined(comparison.more(self.needs, number))
        tests = {test: None for comparison in further for test, _ in comparison.tests}
        instances = [each for test in tests for each in self.instances.get(test, ())]
        plan = replace(self.plan, chunks=tuple(blocks(instances, needs)), needs=needs)
        return needs, [run for run in plan.runs() if run.run_id not in self.earlier]


def options(
    book: Ledger,
    judged: Sequence[Judgement],
    plan: Plan,
    times: Times,
    trials: int,
    done: Set[str] = frozenset(),
) -> list[Option]:
    """Return the open claims about an experiment, the one expected to be decided first at the front.

    `plan` has the needs so far; `trials` is the number of trials of the experiment's config. The forecast
    of a step leaves out the runs in `done`, such as those of a pilot; the ranking counts them.
    """
    claims = {claim.id: claim for claim in book.claims}
    state = _State(plan, times, trials, done)
    found = [
        _option(claims[each.id], comparisons(book, claims[each.id], plan), each, state)
        for each in judged
        if each.verdict in (OPEN, NOT_RUN)
    ]
    return sorted(found, key=lambda option: option.rank)


def _option(
    claim: Claim, compared: Sequence[Comparison], found: Judgement, state: _State
) -> Option:
    own = {each: each.of(found) for each in compared}
    decided = {each for each in compared if each.is_decided(own[each])}
    checks = {each.check for each in decided if each.any_is_enough}
    open_ones = [
        _opened(each, own[each], state)
        for each in compared
        if each not in decided and each.check not in checks
    ]
    if not open_ones:
        nothing = Forecast(0, 0.0, 0)
        why = found.reason if compared else NO_METHODS
        return Option(claim.id, None, state.needs, nothing, nothing, 0, 0.0, why, helps=False)
    able = [each for each in open_ones if not each.obstacle]
    refuting = [each for each in able if each.refutes]
    chosen = min(refuting or able or open_ones, key=lambda each: each.seconds)
    deciding = [chosen] if refuting else _needed(open_ones)
    obstacle = next((each.obstacle for each in deciding if each.obstacle), "")
    # methods that several comparisons share are run once
    expected = {e.comparison: min(e.blocks, state.left(e.comparison)) for e in deciding}
    seconds = state.times.of_runs(state.ahead(expected)[1]).seconds
    return _stepped(claim.id, chosen, seconds, obstacle, helps=bool(able), state=state)


def _needed(open_ones: Sequence[_Open]) -> list[_Open]:
    """Return the comparisons that reproduce a claim: of a check with `any`, only the cheapest."""
    needed = [each for each in open_ones if not each.comparison.any_is_enough]
    alternatives: dict[int, list[_Open]] = {}
    for each in open_ones:
        if each.comparison.any_is_enough:
            alternatives.setdefault(each.comparison.check, []).append(each)
    return needed + [
        min(same, key=lambda each: (bool(each.obstacle), each.seconds))
        for same in alternatives.values()
    ]


def _stepped(
    claim: str, chosen: _Open, seconds: float, obstacle: str, *, helps: bool, state: _State
) -> Option:
    """Return the next step of a comparison: one block, or several short ones."""
    count = min(
        chosen.blocks, state.left(chosen.comparison), int(STEP_S // max(chosen.block.seconds, 1.0))
    )
    needs, runs = state.ahead({chosen.comparison: max(1, count)})
    step = state.times.of_runs(run for run in runs if run.run_id not in state.done)
    return Option(
        claim, chosen.comparison, needs, step, chosen.block, chosen.blocks, seconds, obstacle, helps
    )


def _opened(comparison: Comparison, own: Sequence[Decided], state: _State) -> _Open:
    """Return how many blocks are expected to decide a comparison, and which side its figures are on."""
    done = comparison.blocks_in(state.needs)
    refuting = [] if comparison.any_is_enough else _refuting(comparison, own)
    found = [
        _blocks(comparison, [each], state.needs) if is_whole else _unseen(comparison, done)
        for each, is_whole in refuting
        if each.verdict == OPEN
    ]
    if not found and len(own) < sum(figure.number for figure in comparison.figures):
        found = [_unseen(comparison, done)]
    elif not found:
        open_ones = [[each] for each in own if each.verdict == OPEN]
        together = open_ones if comparison.any_is_enough else [own]
        found = [_blocks(comparison, each, state.needs) for each in together]
    blocks, obstacle = min(found, key=lambda each: (bool(each[1]), each[0]))
    left = state.left(comparison)
    if not obstacle and blocks > left:
        obstacle = f"a decision needs about {blocks} more blocks; only {left} remain in the config"
    block = state.times.of_runs(state.ahead({comparison: 1})[1])
    return _Open(comparison, block, blocks, obstacle, bool(refuting))


def _refuting(comparison: Comparison, own: Sequence[Decided]) -> list[tuple[Decided, bool]]:
    """Return the figures on the other side, if all figures of the same tests and levels are on it.

    Variants of a method must agree, if we do not know which one the authors used. Each figure is returned
    with whether all its variants have a value.
    """
    found: list[tuple[Decided, bool]] = []
    for figure in comparison.figures:
        same = [e for e in own if e.part.cells <= figure.cells]
        wanted = sum(e.number for e in comparison.figures if e.cells == figure.cells)
        if same and all(_is_refuting(each) for each in same):
            known = [each for each, _ in found]
            found += [(each, len(same) == wanted) for each in same if each not in known]
    return found


def _is_refuting(decided: Decided) -> bool:
    """Tell whether a figure lies on the other side, and more trials can show that it does."""
    part = decided.part
    ((side, _),) = part.claimed.items()
    estimate, can_differ = part.estimate, part.rises or part.falls
    if side in ("below", "at_most"):
        can_differ = part.falls
        estimate = part.extremes.least if part.extremes else estimate
    elif side in ("above", "at_least"):
        can_differ = part.rises
        estimate = part.extremes.most if part.extremes else estimate
    is_known = estimate.n >= MIN_SPREAD and not part.cannot_refute and not can_differ
    return is_known and distance(estimate, part.claimed) < 0.0


def _unseen(comparison: Comparison, done: int) -> tuple[int, str]:
    """Return the minimum number of further blocks of a comparison without a value, and its obstacle."""
    enough = min(comparison.least, MIN_SPREAD)
    why = (
        "the runs so far give no value for this comparison (see their statuses)"
        if done >= enough
        else ""
    )
    return max(1, comparison.least - done), why


def _blocks(comparison: Comparison, own: Sequence[Decided], needs: Needs) -> tuple[int, str]:
    """Return the expected number of further blocks after `needs`, and why they do not help."""
    open_ones = [each for each in own if each.verdict == OPEN]
    lacking = [each for each in open_ones if each.why in (FEW, WIDE)]
    if not lacking:
        return 1, open_ones[0].why
    counts = []
    for each in lacking:
        n, needed = each.part.estimate.n, each.needed
        target = each.least if needed is None else needed
        done = max(1, comparison.blocks_in(needs, each.part))
        counts.append(math.ceil(done * target / max(n, 1)) - done)
    if any(each.needed == MOST_NEEDED for each in lacking):
        return max(
            counts
        ), f"the effect is so small that a decision needs more than {MOST_NEEDED} trials"
    return max(1, *counts), ""
