"""From comparisons to verdicts: one per rival and test, and one per claim.

A row is decided by its comparisons: one on the other side refutes it, all on the claimed side reproduce
it. A claim is decided by its rows in the same way. In the quick part of an experiment a comparison with a
run at a limit stays open; in a full experiment the answer at the limit counts, unless more time could
turn the verdict on a success rate.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from reports.ledger import intervals
from reports.ledger.finding import Finding, Part
from reports.ledger.intervals import LEVEL, MIN_TRIALS, NOT, OPEN, REPRODUCED, TIME_OUTS
from workflows.significance import holm

FEW, QUICK_LIMIT, WIDE = "few", "limit", "wide"


@dataclass(frozen=True)
class Decided:
    """A comparison with its decision."""

    part: Part
    verdict: str
    level: float
    why: str = ""  # why it is open

    @property
    def interval(self) -> tuple[float, float]:
        return self.part.estimate.interval(self.level)

    @property
    def margin(self) -> float:
        return intervals.distance(self.part.estimate, self.part.claimed)

    @property
    def needed(self) -> int | None:
        found = _deciding(self.part)
        if found is None:
            return None
        return intervals.needed(found, self.part.claimed, self.level)

    @property
    def least(self) -> int:
        return intervals.least(self.part.estimate, self.part.claimed, self.level)


@dataclass(frozen=True)
class Row:
    """The verdict for one rival and one test."""

    figure: str
    subject: str
    rival: str
    group: str
    verdict: str
    decided: tuple[Decided, ...]
    shown_only: bool = False
    check: int = 0  # number of the check in the claim
    second_title: str = ""
    second: Mapping[tuple[str, ...], intervals.Estimate] = field(default_factory=dict)

    @property
    def shown(self) -> Decided:
        """The comparison farthest from the claimed side, of those with the row's verdict."""
        return min((d for d in self.decided if d.verdict == self.verdict), key=lambda d: d.margin)

    @property
    def names(self) -> str:
        against = f" against {self.rival}" if self.rival else ""
        return f"{self.subject}{against}"

    @property
    def runs(self) -> dict[str, bool]:
        """The runs behind the row, each with whether it ended at a limit."""
        return {run: late for d in self.decided for run, late in d.part.runs.items()}

    @property
    def limited(self) -> int:
        return sum(self.runs.values())

    @property
    def value(self) -> str:
        """The figure and its interval."""
        return _shown(self.shown.part.estimate, self.shown.level)

    @property
    def second_value(self) -> str:
        """The error above the floor, or the work, of the shown comparison; empty if there is none."""
        part = self.shown.part
        found = self.second.get((part.subject, part.rival, part.group, part.where))
        return _shown(found, self.shown.level) if found else ""

    @property
    def claimed(self) -> str:
        """The claimed side and its threshold in words."""
        ((side, threshold),) = self.shown.part.claimed.items()
        if side == "within":
            return "{:g} to {:g}".format(*threshold)
        return f"{side.replace('_', ' ')} {threshold:g}"

    @property
    def limited_share(self) -> str:
        """How many runs behind the row ended at a limit."""
        return f"{self.limited} of {len(self.runs)}" if self.runs else ""

    @property
    def open_because(self) -> str:
        """Why the row is open, and how many trials a decision needs; empty if it is decided."""
        reasons = [d for d in self.decided if d.verdict == OPEN]
        if self.verdict != OPEN:
            return ""
        texts = []
        if any(d.why == QUICK_LIMIT for d in reasons):
            texts.append("runs hit a limit: run the full experiment")
        known = (FEW, QUICK_LIMIT, WIDE)
        texts += dict.fromkeys(d.why for d in reasons if d.why not in known)
        lacking = [d for d in reasons if d.why in (FEW, WIDE)]
        if lacking:
            texts.append(_most_lacking(lacking))
        return "; ".join(texts)


def decide(findings: Sequence[Finding], *, quick: bool, missing: int = 0) -> list[list[Decided]]:
    """Decide the comparisons of a claim, with Holm's correction over those of its verdict.

    Comparisons that cannot be decided yet take part, and so do the `missing` ones, which have no figure:
    their number must not depend on when the results are examined.
    """
    parts = [part for finding in findings for part in finding.parts]
    barred = [_barred(part, quick=quick) for part in parts]
    p_of = [
        intervals.p_values(
            part.estimate, part.claimed, rises=part.rises, falls=part.falls, extremes=part.extremes
        )
        for part in parts
    ]
    family = [at for at, part in enumerate(parts) if not part.shown_only]
    p_values = [1.0 if barred[at] else min(p_of[at]) for at in family]
    p_values += [1.0] * missing
    levels = dict.fromkeys(range(len(parts)), LEVEL)
    levels |= dict(zip(family, holm(p_values, LEVEL), strict=False))
    decided = []
    for part, why, p, level in zip(parts, barred, p_of, levels.values(), strict=True):
        verdict = OPEN if why else intervals.decide(*p, level)
        if verdict == OPEN and not why:
            why = _why(part, level)
        if verdict == NOT and part.cannot_refute:
            verdict, why = OPEN, part.cannot_refute
        if verdict == REPRODUCED and part.cannot_show:
            verdict, why = OPEN, part.cannot_show
        decided.append(Decided(part, verdict, level, why))
    ends = iter(decided)
    return [agreed(finding, [next(ends) for _ in finding.parts]) for finding in findings]


def agreed(finding: Finding, decided: Sequence[Decided]) -> list[Decided]:
    """Open the comparisons on which methods that differ by a choice of ours do not agree."""
    found = list(decided)
    for role, names in finding.choices:
        same: dict[tuple[str, ...], list[int]] = {}
        for at, each in enumerate(found):
            part = each.part
            if part.rival in names or part.subject in names:
                other = part.subject if part.rival in names else part.rival
                place = (other, part.group, part.where)
                same.setdefault(place, []).append(at)
        for members in same.values():
            verdicts = {found[at].verdict for at in members}
            if len(verdicts) == 1 and len(members) == role.n_choices:
                continue
            why = f"not all variants of {role.title} agree ({' and '.join(role.choices)})"
            for at in members:
                if found[at].verdict != OPEN:
                    found[at] = replace(found[at], verdict=OPEN, why=why)
    return found


def _why(part: Part, level: float) -> str:
    """Return why a comparison with enough trials is open."""
    found = _deciding(part)
    if found is None:
        return part.extremes.because if part.extremes else WIDE
    would = intervals.p_values(found, part.claimed)
    return WIDE if intervals.decide(*would, level) == OPEN else TIME_OUTS


def _deciding(part: Part) -> intervals.Estimate | None:
    """Return the estimate whose interval decides: of two extremes, the one nearer to the threshold.

    None if the extremes lie on different sides, where no number of trials decides.
    """
    if part.extremes is None:
        return part.estimate
    ends = {
        intervals.distance(end, part.claimed): end
        for end in (part.extremes.least, part.extremes.most)
    }
    is_split = len({at > 0.0 for at in ends}) > 1
    return None if is_split else ends[min(ends, key=abs)]


def _barred(part: Part, *, quick: bool) -> str:
    if quick and any(part.runs.values()):
        return QUICK_LIMIT
    return FEW if part.estimate.n < MIN_TRIALS else ""


def rows(
    finding: Finding,
    decided: Sequence[Decided],
    check: int,
    second_title: str = "",
    second: Mapping[tuple[str, ...], Any] | None = None,
) -> list[Row]:
    """Group the comparisons of a finding by subject, rival and test."""
    grouped: dict[tuple[str, str, str], list[Decided]] = {}
    for each in decided:
        key = each.part.subject, each.part.rival, each.part.group
        grouped.setdefault(key, []).append(each)
    return [
        Row(
            finding.figure, *key, of_all(d.verdict for d in members), tuple(members),
            shown_only=members[0].part.shown_only, check=check, second_title=second_title,
            second=second or {},
        )
        for key, members in grouped.items()
    ]  # fmt: skip


def of_all(verdicts: Iterable[str]) -> str:
    """Return the joint verdict if every one must be reproduced."""
    found = set(verdicts)
    return NOT if NOT in found else OPEN if OPEN in found else REPRODUCED


def of_any(verdicts: Iterable[str]) -> str:
    """Return the joint verdict if one reproduced is enough."""
    found = set(verdicts)
    return REPRODUCED if REPRODUCED in found else OPEN if OPEN in found else NOT


def _shown(estimate: intervals.Estimate, level: float) -> str:
    low, high = estimate.interval(level)
    if isinstance(estimate, intervals.Exact):
        return f"{estimate.value:.3g}"
    return f"{estimate.value:.3g} [{low:.3g}, {high:.3g}]"


def _most_lacking(lacking: Sequence[Decided]) -> str:
    """Return how many trials the comparison has that needs most of them, and how many it needs."""
    most = max(lacking, key=lambda each: (each.needed is None, each.needed or each.least))
    number = f"{min(most.needed or most.least, intervals.MOST_NEEDED):,}".replace(",", "\u202f")
    if most.needed is None:
        number = f"an unknown number, at least {number}"
    elif most.needed >= intervals.MOST_NEEDED:
        number = f"more than {number}"
    elif most.needed > most.least:
        number = f"about {number}"
    return f"has {most.part.estimate.n} trials, needs {number}"
