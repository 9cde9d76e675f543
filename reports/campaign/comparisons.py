"""The comparisons of a claim as parts of an experiment: what one block runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from baselines import registry
from reports.ledger import intervals, planned
from reports.ledger.book import Claim, Ledger
from reports.ledger.checks import SHARES
from reports.ledger.evidence import methods_in
from reports.ledger.finding import Part
from reports.ledger.intervals import LEVEL, OPEN, REPRODUCED, Exact, Figure, Median, Share
from reports.ledger.judging import Judgement
from reports.ledger.planned import Planned
from reports.ledger.verdicts import Decided
from reports.theme import words
from workflows.blocks import Needs
from workflows.installed import runs_here
from workflows.stages.plan import Plan


@dataclass(frozen=True)
class Comparison:
    """The methods that a check compares in a test, or in several tests together.

    Attributes
    ----------
    check : int
        Number of the check in the claim.
    any_is_enough : bool
        Whether one figure on the claimed side is enough for the check.
    tests : tuple of (str, tuple of float)
        Each test with the compared levels.
    methods : tuple of str
    figures : tuple of Planned
    least : int
        Minimum number of blocks with enough trials for a decision.
    """

    check: int
    any_is_enough: bool
    tests: tuple[tuple[str, tuple[float, ...]], ...]
    methods: tuple[str, ...]
    figures: tuple[Planned, ...]
    least: int

    def __str__(self) -> str:
        tests = (
            f"{words(test)} {' to '.join(f'{level:g}' for level in sorted({levels[0], levels[-1]}))}"
            for test, levels in self.tests
        )
        return f"{', '.join(tests)}: {', '.join(self.methods)}"

    def of(self, found: Judgement) -> list[Decided]:
        """Return the figures that a judgement has of this comparison."""
        return [
            each
            for row in found.rows
            if row.check == self.check
            for each in row.decided
            if any(figure.has(each.part) for figure in self.figures)
        ]

    def is_decided(self, own: Sequence[Decided]) -> bool:
        """Tell whether these figures of the comparison are all decided, and none is missing."""
        if self.any_is_enough and any(each.verdict == REPRODUCED for each in own):
            return True
        number = sum(figure.number for figure in self.figures)
        return len(own) >= number and all(each.verdict != OPEN for each in own)

    def more(self, needs: Needs, blocks: int) -> Needs:
        """Return needs with further blocks of this comparison."""
        for test, levels in self.tests:
            for _ in range(blocks):
                needs = needs.with_block(test, self.methods, levels)
        return needs

    def blocks_in(self, needs: Needs, part: Part | None = None) -> int:
        """Return how many blocks were run of it, or of the tests, levels and methods of a figure."""
        if part is None:
            return min(needs.of_all(test, self.methods, levels) for test, levels in self.tests)
        return min(
            needs.of_all(
                test, part.methods, [level for other, level in part.cells if other == test]
            )
            for test in {test for test, _ in part.cells}
        )


def comparisons(book: Ledger, claim: Claim, plan: Plan) -> list[Comparison]:
    """Return the deciding comparisons of a claim whose methods are installed."""
    settings = [
        (method.name, method.baseline, registry.effective_options(method.baseline, method.options),
         method.n_inliers_ratio)
        for method in plan.methods if runs_here(method)
    ]  # fmt: skip
    first = planned.first_block([entry.model_dump() for entry in plan.experiment.datasets])
    drafts = []
    for at, check in enumerate(claim.checks):
        if check.get("shown_only"):
            continue
        compared = planned.compared(check, first, book.axes)
        for block, roles in product(_by_test(check, compared), planned.roles(check)):
            filled = [methods_in(book.roles[role], settings) for role in roles]
            if all(filled):
                figures = tuple(planned.comparisons(check, block, filled))
                drafts.append((at, check, block, filled, figures))
    # Holm's correction tests the smallest p-value at this level
    level = LEVEL / max(1, sum(figure.number for *_, figures in drafts for figure in figures))
    return [_comparison(*draft, level) for draft in drafts]


def _comparison(
    at: int,
    check: Mapping[str, Any],
    block: pd.DataFrame,
    filled: Sequence[Sequence[str]],
    figures: tuple[Planned, ...],
    level: float,
) -> Comparison:
    """Return the comparison of the methods of some roles on the instances of a block."""
    tests = tuple(
        (str(test), tuple(sorted(map(float, levels.unique()))))
        for test, levels in block.groupby("test", sort=False)["level"]
    )
    return Comparison(
        check=at,
        any_is_enough=bool(check.get("any")),
        tests=tests,
        methods=tuple(dict.fromkeys(name for each in filled for name in each)),
        figures=figures,
        least=_least(check, block, level),
    )


def _least(check: Mapping[str, Any], block: pd.DataFrame, level: float) -> int:
    """Return the minimum number of blocks for a decision, if all trials are as the claim says."""
    needed = intervals.least(_ideal(check), check["claimed"], level)
    return max(
        math.ceil(needed / planned.trials_in(place)) for place in planned.places(check, block)
    )


def _ideal(check: Mapping[str, Any]) -> intervals.Estimate:
    """Return an estimate of the kind of a check; a share is as the claim says."""
    if check["kind"] == "regret" or check.get("quantity") in SHARES:
        return Share(float(not {"above", "at_least"}.isdisjoint(check["claimed"])), 1)
    if check.get("statistic") == "median":
        return Median(np.ones(1))
    return Exact(0.0, 1) if check.get("statistic") == "maximum" else Figure(0.0, 1, 1.0)


def _by_test(check: Mapping[str, Any], block: pd.DataFrame) -> list[pd.DataFrame]:
    """Return the instances of a check by test, or together if one figure is about all tests."""
    if planned.is_by_test(check):
        return [part for _, part in block.groupby("test", sort=False)]
    return [block] if len(block) else []
