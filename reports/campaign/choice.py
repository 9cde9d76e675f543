"""Choose the next block: of the claim that is expected to be decided in the shortest time.

A claim consists of comparisons. One on the other side refutes it, and all on the claimed side reproduce
it. So the comparisons of a claim are run one after the other: first one that is expected to refute it,
else the one that takes the shortest time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import product
from typing import Any

import pandas as pd

from baselines import registry
from reports.campaign.forecast import Forecast, Times
from reports.ledger import planned
from reports.ledger.book import Claim, Ledger
from reports.ledger.intervals import MIN_INSTANCES, MOST_NEEDED, NOT_RUN, OPEN, distance
from reports.ledger.judging import Judgement
from reports.ledger.verdicts import FEW, WIDE, Decided
from reports.theme import words
from workflows.blocks import Needs
from workflows.outlook import runs_here
from workflows.stages.plan import Plan, PlannedRun, expand

# A step has several blocks if they are expected to take less time: planning, judging and the tables take
# about half a minute per step.
STEP_S = 300.0
NO_METHODS = "the experiment has none of the methods that the claim compares"


@dataclass(frozen=True)
class Comparison:
    """The methods that a check compares in a test, or in several tests together.

    Attributes
    ----------
    tests : tuple of (str, tuple of float)
        Each test with the compared levels.
    methods : tuple of str
    least : int
        Blocks with the minimum number of instances for a decision.
    can_refute : bool
        Whether the other side refutes the claim, whatever the other comparisons show.
    """

    tests: tuple[tuple[str, tuple[float, ...]], ...]
    methods: tuple[str, ...]
    least: int
    can_refute: bool = True

    def __str__(self) -> str:
        tests = (
            f"{words(test)} {'–'.join(f'{level:g}' for level in sorted({levels[0], levels[-1]}))}"
            for test, levels in self.tests
        )
        return f"{', '.join(tests)}: {', '.join(self.methods)}"

    def has(self, run: PlannedRun) -> bool:
        """Tell whether a run is one of the compared ones."""
        levels = dict(self.tests).get(run.instance.test, ())
        return run.method.name in self.methods and run.instance.level in levels

    def more(self, needs: Needs, blocks: int) -> Needs:
        """Return needs with further blocks of this comparison."""
        for test, levels in self.tests:
            for _ in range(blocks):
                needs = needs.with_block(test, self.methods, levels)
        return needs

    def blocks_in(self, needs: Needs) -> int:
        return min(needs.of_all(test, self.methods, levels) for test, levels in self.tests)


@dataclass(frozen=True)
class Option:
    """A claim that more blocks may decide.

    Attributes
    ----------
    claim : str
    comparison : Comparison or None
        The one to run next; None if the experiment has none of the methods.
    needs : Needs
        The blocks after its next step, which has one block or several short ones.
    step, block : Forecast
        Of the runs of the next step without a result, and of all runs of the next block.
    blocks : int
        Number of further blocks that are expected to decide the comparison.
    seconds : float
        The expected time until the claim is decided.
    obstacle : str
        Why more blocks do not help.
    """

    claim: str
    comparison: Comparison | None
    needs: Needs
    step: Forecast
    block: Forecast
    blocks: int
    seconds: float
    obstacle: str = ""


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

    def left(self, comparison: Comparison) -> int:
        """Return how many more blocks of a comparison the experiment has."""
        return max(0, self.trials - comparison.blocks_in(self.needs))

    def ahead(self, blocks: Mapping[Comparison, int]) -> tuple[Needs, list[PlannedRun]]:
        """Return the needs with further blocks of comparisons, and the runs that they add."""
        needs, plan = self.needs, self.plan
        for comparison, number in blocks.items():
            needs = comparison.more(needs, number)
        earlier = {run.run_id for run in plan.runs()}
        runs = expand(plan.experiment, plan.selection, plan.config, needs).runs()
        return needs, [run for run in runs if run.run_id not in earlier]


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
    state = _State(plan, times, trials, done)
    found = [
        _option(claims[each.id], comparisons(book, claims[each.id], plan), each, state)
        for each in judged
        if each.verdict in (OPEN, NOT_RUN)
    ]
    return sorted(found, key=lambda option: (bool(option.obstacle), option.seconds, option.claim))


def _option(
    claim: Claim, compared: Sequence[Comparison], found: Judgement, state: _State
) -> Option:
    runs = {run.run_id: run for run in state.plan.runs()}
    decided = [each for row in found.rows if not row.shown_only for each in row.decided]
    open_ones = []
    for comparison in compared:
        own = [each for each in decided if _belongs(each, comparison, runs)]
        if own and all(each.verdict != OPEN for each in own):
            continue
        open_ones.append(_opened(comparison, own, state))
    if not open_ones:
        nothing = Forecast(0, 0.0, 0)
        return Option(claim.id, None, state.needs, nothing, nothing, 0, 0.0, NO_METHODS)
    refuting = [each for each in open_ones if each.refutes and not each.obstacle]
    chosen = min(refuting or open_ones, key=lambda each: (bool(each.obstacle), each.seconds))
    deciding = [chosen] if refuting else open_ones
    obstacle = next((each.obstacle for each in deciding if each.obstacle), "")
    # methods that several comparisons share are run once
    expected = {e.comparison: min(e.blocks, state.left(e.comparison)) for e in deciding}
    seconds = state.times.of_runs(state.ahead(expected)[1]).seconds
    return _stepped(claim.id, chosen, seconds, obstacle, state)


def _stepped(claim: str, chosen: _Open, seconds: float, obstacle: str, state: _State) -> Option:
    """Return the next step of a comparison: one block, or several short ones."""
    count = min(
        chosen.blocks, state.left(chosen.comparison), int(STEP_S // max(chosen.block.seconds, 1.0))
    )
    needs, runs = state.ahead({chosen.comparison: 1 if obstacle else max(1, count)})
    step = state.times.of_runs(run for run in runs if run.run_id not in state.done)
    return Option(
        claim, chosen.comparison, needs, step, chosen.block, chosen.blocks, seconds, obstacle
    )


def _belongs(decided: Decided, comparison: Comparison, runs: Mapping[str, PlannedRun]) -> bool:
    """Tell whether all runs behind a decision are runs of the comparison."""
    own = [runs[run] for run in decided.part.runs if run in runs]
    return bool(own) and all(comparison.has(run) for run in own)


def _opened(comparison: Comparison, own: Sequence[Decided], state: _State) -> _Open:
    """Return how many blocks are expected to decide a comparison, and which side its figure is on."""
    done = comparison.blocks_in(state.needs)
    refuting = [each for each in own if comparison.can_refute and _is_refuting(each)]
    found = [_blocks([each], done, comparison.least) for each in refuting] or [
        _blocks(own, done, comparison.least)
    ]
    blocks, obstacle = min(found, key=lambda each: (bool(each[1]), each[0]))
    left = state.left(comparison)
    if not obstacle and blocks > left:
        obstacle = f"it needs {done + blocks} trials, and the experiment has {state.trials}"
    block = state.times.of_runs(state.ahead({comparison: 1})[1])
    return _Open(comparison, block, blocks, obstacle, bool(refuting))


def _is_refuting(decided: Decided) -> bool:
    """Tell whether an open figure lies on the other side, and more instances can show that it does."""
    part = decided.part
    ((side, _),) = part.claimed.items()
    estimate, can_differ = part.estimate, part.rises or part.falls
    if side in ("below", "at_most"):
        can_differ = part.falls
        estimate = part.extremes.least if part.extremes else estimate
    elif side in ("above", "at_least"):
        can_differ = part.rises
        estimate = part.extremes.most if part.extremes else estimate
    is_open = decided.verdict == OPEN and not part.cannot_refute and not can_differ
    return is_open and distance(estimate, part.claimed) < 0.0


def _blocks(own: Sequence[Decided], done: int, least: int) -> tuple[int, str]:
    """Return the expected number of further blocks, and why they do not help.

    `done` is the number of blocks so far.
    """
    open_ones = [each for each in own if each.verdict == OPEN]
    if not open_ones:  # no run yet
        return max(1, least - done), ""
    lacking = [each for each in open_ones if each.why in (FEW, WIDE)]
    if not lacking:
        return 1, open_ones[0].why
    counts = []
    for each in lacking:
        n, needed = each.part.estimate.n, each.needed
        target = MIN_INSTANCES if needed is None else needed
        counts.append(math.ceil(max(1, done) * target / max(n, 1)) - done)
    if any(each.needed == MOST_NEEDED for each in lacking):
        return max(counts), f"an effect so small that it needs more than {MOST_NEEDED} instances"
    return max(1, *counts), ""


def comparisons(book: Ledger, claim: Claim, plan: Plan) -> list[Comparison]:
    """Return the comparisons that decide a claim, those without methods in the plan left out."""
    settings = [
        (method.name, method.baseline, registry.effective_options(method.baseline, method.options),
         method.n_inliers_ratio)
        for method in plan.methods if runs_here(method)
    ]  # fmt: skip
    first = planned.first_block([entry.model_dump() for entry in plan.experiment.datasets])
    found: dict[tuple[Any, ...], Comparison] = {}
    for check in claim.checks:
        if check.get("shown_only"):
            continue
        can_refute = not check.get("any")
        for block, filled in product(
            _by_test(check, planned.compared(check, first, book.axes)),
            list(planned.pairs(check, book.roles, settings)),
        ):
            names = tuple(dict.fromkeys(name for each in filled for name in each))
            tests = tuple(
                (str(test), tuple(sorted(map(float, levels.unique()))))
                for test, levels in block.groupby("test", sort=False)["level"]
            )
            least = math.ceil(MIN_INSTANCES / planned.instances(check, block))
            if known := found.get((tests, names)):
                least, can_refute = max(least, known.least), can_refute or known.can_refute
            found[tests, names] = Comparison(tests, names, least, can_refute)
    return list(found.values())


def _by_test(check: Mapping[str, Any], block: pd.DataFrame) -> list[pd.DataFrame]:
    """Return the instances of a check by test, or together if one figure is about all tests."""
    if "test" in planned.columns_of(check, block):
        return [part for _, part in block.groupby("test", sort=False)]
    return [block] if len(block) else []
