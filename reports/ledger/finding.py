"""What a check of the ledger finds, and what runs at a limit leave open of it.

A check takes the tables of one experiment and its parameters from the ledger, and returns a
`Finding`: parts with a figure and an interval each, and which runs they rest on. Common parameters:
``tests``, ``levels`` (a list, or ``top``, ``bottom`` of several, ``disturbed``: above 0; levels beyond
the paper's own axes only where a list names them), ``by`` (columns: a part per group), ``any`` (one part
is enough), and ``claimed``, the side on which a figure has to lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from reports.ledger import intervals
from reports.ledger.evidence import QUICK, Evidence, Experiment, Role, imagined
from reports.ledger.intervals import Interval
from reports.theme import words

Parameters = Mapping[str, Any]
LIMITED, SETTLED = "limited", "settled"  # ends of runs; settled: at a limit, but proven optimal
BEST_FIRST = (intervals.REPRODUCED, intervals.OPEN, intervals.NOT)


@dataclass(frozen=True)
class Part:
    """One comparison of a check."""

    where: str
    interval: Interval
    verdict: str
    margin: float
    hangs: bool = False  # open for runs at a limit: they might have turned it


@dataclass
class Finding:
    """What a check found: its parts, the runs they rest on, and methods that were not there."""

    figure: str  # what the numbers are
    parts: list[Part] = field(default_factory=list)
    runs: dict[str, str] = field(default_factory=dict)  # run_id -> outcome
    methods: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def add(self, where: str, interval: Interval, claimed: Parameters) -> None:
        verdict = intervals.judge(interval, claimed)
        self.parts.append(Part(where, interval, verdict, intervals.distance(interval, claimed)))

    def rest_on(self, *tables: pd.DataFrame) -> None:
        for table in tables:
            ends = table["outcome"].mask(table["settled"], SETTLED)
            self.runs.update(zip(table["run_id"], ends, strict=True))
            self.methods += [m for m in table["method"].unique() if m not in self.methods]


# What became of runs at a limit, as a mask over their levels: to their least (False) or their most.
Fate = Callable[[pd.Series], pd.Series]


def none(levels: pd.Series) -> pd.Series:
    return levels > np.inf


def top(levels: pd.Series) -> pd.Series:
    return levels == levels.max()


def upper(levels: pd.Series) -> pd.Series:
    return levels > levels.unique().mean()


def both_ways(fate: Fate) -> tuple[Fate, Fate]:
    """A fate and its contrary."""
    return fate, lambda levels: ~fate(levels)


@dataclass(frozen=True)
class Source:
    """What a check may look at."""

    evidence: Evidence
    experiment: Experiment | None
    roles: Mapping[str, Role]
    axes: Mapping[str, float] = field(default_factory=dict)  # test -> last level the paper shows
    fates: tuple[Fate, Fate] | None = None  # of the subject's and of the rivals' runs at a limit

    def runs(
        self, role: str, p: Parameters, finding: Finding
    ) -> Iterator[tuple[str, pd.DataFrame]]:
        """Name and chosen runs of every method in a role; noted as missing if there is none."""
        assert self.experiment is not None
        labels = self.experiment.playing(self.roles[role])
        tried = self.experiment.runs
        if not isinstance(p.get("levels"), list):
            tried = tried[tried["level"] <= tried["test"].map(self.axes).fillna(np.inf)]
        finding.missing += [what for what in _absent(tried, p) if what not in finding.missing]
        chosen = [(label, select(tried, label, p)) for label in labels]
        filled = [(label, runs) for label, runs in chosen if len(runs)]
        title = self.roles[role].title
        what = f"{title} in these tests and levels" if labels else title
        if not filled and what not in finding.missing:
            finding.missing.append(what)
        names = self.experiment.runs.drop_duplicates("method").set_index("method")["display_name"]
        for label, runs in filled:
            if self.fates:
                fate = self.fates[role in p.get("rivals", ())]
                runs = imagined(runs, runs.groupby("test")["level"].transform(fate).to_numpy())
            yield names[label], runs


Check = Callable[[Source, Parameters], Finding]
CHECKS: dict[str, Check] = {}
STUDY_CHECKS: set[str] = set()  # those over the study of bounds
FATES: dict[str, tuple[Fate, ...]] = {}  # that hold the extremes of a kind of check; none: unknown


def check(
    name: str, *, of_study: bool = False, fates: tuple[Fate, ...] = both_ways(none)
) -> Callable[[Check], Check]:
    """Register a kind of check. Its figure is monotone in every run unless told otherwise."""

    def register(function: Check) -> Check:
        CHECKS[name], FATES[name] = function, fates
        if of_study:
            STUDY_CHECKS.add(name)
        return function

    return register


def found(source: Source, p: Parameters, *, limits_decide: bool = False) -> Finding:
    """What a check finds; a part is open where runs at a limit, gone on, could have turned it.

    With ``any``, one part on the claimed side is enough: of the parts those that speak best for it count.
    """
    finding = CHECKS[p["kind"]](source, p)
    if not limits_decide and (LIMITED in finding.runs.values() or _of_work(p, finding)):
        _doubt(finding, source, p)
    if p.get("any"):
        best = min((BEST_FIRST.index(part.verdict) for part in finding.parts), default=0)
        finding.parts = [part for part in finding.parts if BEST_FIRST.index(part.verdict) == best]
    return finding


def _doubt(finding: Finding, source: Source, p: Parameters) -> None:
    """Open the parts that runs at a limit could have turned."""
    kind = p["kind"]
    worlds = [
        CHECKS[kind](replace(source, fates=(mine, theirs)), p).parts
        for mine, theirs in product(FATES[kind], repeat=2)
    ]
    finding.parts = [
        part
        if worlds and _stands(part, [world[at] for world in worlds], p["claimed"])
        else replace(part, verdict=intervals.OPEN, hangs=part.verdict != intervals.OPEN)
        for at, part in enumerate(finding.parts)
    ]


def _stands(part: Part, extremes: Sequence[Part], claimed: Parameters) -> bool:
    """Whether a verdict is that of all extremes, and of what lies between them."""
    if any(other.verdict != part.verdict for other in extremes):
        return False
    # on either side of a claimed range, or value: between them lies the range
    low = min(other.interval.low for other in extremes)
    high = max(other.interval.high for other in extremes)
    hull = replace(part.interval, low=low, high=high)
    return part.verdict != intervals.NOT or intervals.judge(hull, claimed) == intervals.NOT


def _of_work(p: Parameters, finding: Finding) -> bool:
    """Whether a figure of time or boxes rests on runs at a limit, settled ones too.

    Or, in a race, on searches that ended without a bound, by themselves as well.
    """
    quantities = {p.get("quantity"), *p.get("quantities", ())}
    if p["kind"] == "race":
        return True
    return bool(quantities & {"time", "n_nodes"}) and SETTLED in finding.runs.values()


def _absent(runs: pd.DataFrame, p: Parameters) -> Iterator[str]:
    """Tests and levels that a check names and no run of the experiment is of."""
    # a list and its quick part are the same test
    present = {test.removesuffix(QUICK) for test in runs["test"].unique()}
    for test in dict.fromkeys(test.removesuffix(QUICK) for test in p.get("tests", ())):
        if test not in present:
            yield words(test)
    if isinstance(p.get("levels"), list):
        of_tests = runs[runs["test"].isin(p.get("tests", runs["test"].unique()))]
        for level in p["levels"]:
            if level not in of_tests["level"].unique():
                yield f"level {level:g}"


def select(runs: pd.DataFrame, method: str, p: Parameters) -> pd.DataFrame:
    """Runs of a method in the tests and levels of a check, as far as the experiment has them."""
    part = runs[
        (runs["method"] == method) & runs["test"].isin(p.get("tests", runs["test"].unique()))
    ]
    levels = part.groupby("test")["level"]
    match p.get("levels"):
        case "top":
            part = part[part["level"] == levels.transform("max")]
        case "bottom":  # the only level of a test is its top
            part = part[
                (part["level"] == levels.transform("min")) & (levels.transform("nunique") > 1)
            ]
        case "disturbed":
            part = part[part["level"] > 0]
        case [*wanted]:
            part = part[part["level"].isin(wanted)]
    for column, value in p.get("where", {}).items():
        part = part[part[column] == value]
    return part


def groups(table: pd.DataFrame, p: Parameters) -> Iterator[tuple[str, pd.DataFrame]]:
    """The parts of a table by the columns of ``by``, with a name each."""
    by = p.get("by", ["test", "level"])
    if not by:
        if len(table):
            yield "all", table
        return
    for _, part in table.groupby(by, sort=False):
        key = part.iloc[0][by]
        texts = [f"{value:g}" if isinstance(value, float) else words(str(value)) for value in key]
        yield ", ".join(texts), part


def paired(one: pd.DataFrame, other: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Both values on every common instance; axes of the instance from the first."""
    both = one.merge(other[["instance_id", quantity]], on="instance_id", suffixes=("", "_rival"))
    return both.dropna(subset=[quantity, f"{quantity}_rival"])
