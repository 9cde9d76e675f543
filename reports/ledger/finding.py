"""The result of a check of the ledger, and whether runs at a limit could change it.

A check takes the tables of one experiment and its parameters from the ledger. It returns a `Finding`:
parts with a figure and an interval each, and the runs that they are based on. Parameters: ``tests``;
``levels`` (a list, or ``top``, ``bottom`` of several, ``disturbed``: above 0; levels beyond the paper's
axes only if a list names them); ``by`` (columns: a part per group); ``any`` (one part is enough); and
``claimed``, the side on which a figure must lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from reports.ledger import intervals
from reports.ledger.evidence import QUICK, Evidence, Experiment, Role, hypothetical
from reports.ledger.intervals import Interval
from reports.theme import words

Parameters = Mapping[str, Any]
LIMITED, SETTLED = "limited", "settled"  # settled: at a limit, but proven optimal
BEST_FIRST = (intervals.REPRODUCED, intervals.OPEN, intervals.NOT)


@dataclass(frozen=True)
class Part:
    """One comparison of a check."""

    where: str
    interval: Interval
    verdict: str
    margin: float
    depends: bool = False  # open because runs at a limit could change it


@dataclass
class Finding:
    """The result of a check: its parts, the runs they are based on, and what is missing."""

    figure: str  # what the numbers are
    parts: list[Part] = field(default_factory=list)
    runs: dict[str, str] = field(default_factory=dict)  # run_id -> outcome
    methods: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def add(self, where: str, interval: Interval, claimed: Parameters) -> None:
        verdict = intervals.judge(interval, claimed)
        self.parts.append(Part(where, interval, verdict, intervals.distance(interval, claimed)))

    def use(self, *tables: pd.DataFrame) -> None:
        for table in tables:
            ends = table["outcome"].mask(table["settled"], SETTLED)
            self.runs.update(zip(table["run_id"], ends, strict=True))
            self.methods += [m for m in table["method"].unique() if m not in self.methods]


# A scenario of runs at a limit, by their levels: each reaches its minimum (False) or maximum (True).
Scenario = Callable[[pd.Series], pd.Series]


def none(levels: pd.Series) -> pd.Series:
    return levels > np.inf


def top(levels: pd.Series) -> pd.Series:
    return levels == levels.max()


def upper(levels: pd.Series) -> pd.Series:
    return levels > levels.unique().mean()


def both_ways(scenario: Scenario) -> tuple[Scenario, Scenario]:
    """Return a scenario and its opposite."""
    return scenario, lambda levels: ~scenario(levels)


@dataclass(frozen=True)
class Source:
    """The tables and roles that a check may use."""

    evidence: Evidence
    experiment: Experiment | None
    roles: Mapping[str, Role]
    axes: Mapping[str, float] = field(default_factory=dict)  # test -> last level the paper shows
    scenarios: tuple[Scenario, Scenario] | None = None  # of the subject and of the rivals

    def runs(
        self, role: str, p: Parameters, finding: Finding
    ) -> Iterator[tuple[str, pd.DataFrame]]:
        """Yield name and selected runs of every method in a role; note a role without any."""
        assert self.experiment is not None
        labels = self.experiment.methods_in(self.roles[role])
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
            if self.scenarios:
                scenario = self.scenarios[role in p.get("rivals", ())]
                at_maximum = runs.groupby("test")["level"].transform(scenario).to_numpy()
                runs = hypothetical(runs, at_maximum)
            yield names[label], runs


Check = Callable[[Source, Parameters], Finding]
CHECKS: dict[str, Check] = {}
STUDY_CHECKS: set[str] = set()  # checks of the study of bounds
# Scenarios whose combinations contain the extremes of a kind of check; empty: unknown.
SCENARIOS: dict[str, tuple[Scenario, ...]] = {}


def check(
    name: str, *, of_study: bool = False, scenarios: tuple[Scenario, ...] = both_ways(none)
) -> Callable[[Check], Check]:
    """Register a kind of check; with the default scenarios, its figure is monotone in every run."""

    def register(function: Check) -> Check:
        CHECKS[name], SCENARIOS[name] = function, scenarios
        if of_study:
            STUDY_CHECKS.add(name)
        return function

    return register


def found(source: Source, p: Parameters, *, limits_decide: bool = False) -> Finding:
    """Run a check; a part is inconclusive if runs at a limit could change its verdict.

    With ``any``, one part on the claimed side is enough: only the parts with the best verdict count.
    """
    finding = CHECKS[p["kind"]](source, p)
    if not limits_decide and (LIMITED in finding.runs.values() or _of_work(p, finding)):
        _open_dependent(finding, source, p)
    if p.get("any"):
        best = min((BEST_FIRST.index(part.verdict) for part in finding.parts), default=0)
        finding.parts = [part for part in finding.parts if BEST_FIRST.index(part.verdict) == best]
    return finding


def _open_dependent(finding: Finding, source: Source, p: Parameters) -> None:
    """Make the parts inconclusive that runs at a limit could change."""
    kind = p["kind"]
    cases = [
        CHECKS[kind](replace(source, scenarios=(mine, theirs)), p).parts
        for mine, theirs in product(SCENARIOS[kind], repeat=2)
    ]
    finding.parts = [
        part
        if cases and _stands(part, [case[at] for case in cases], p["claimed"])
        else replace(part, verdict=intervals.OPEN, depends=part.verdict != intervals.OPEN)
        for at, part in enumerate(finding.parts)
    ]


def _stands(part: Part, extremes: Sequence[Part], claimed: Parameters) -> bool:
    """Whether a verdict holds for all extremes and for the values between them."""
    if any(other.verdict != part.verdict for other in extremes):
        return False
    # extremes on both sides of a claimed range contain the range
    low = min(other.interval.low for other in extremes)
    high = max(other.interval.high for other in extremes)
    hull = replace(part.interval, low=low, high=high)
    return part.verdict != intervals.NOT or intervals.judge(hull, claimed) == intervals.NOT


def _of_work(p: Parameters, finding: Finding) -> bool:
    """Whether a figure of time or boxes is based on runs at a limit, settled ones included.

    A race also depends on searches that finished without a bound.
    """
    quantities = {p.get("quantity"), *p.get("quantities", ())}
    if p["kind"] == "race":
        return True
    return bool(quantities & {"time", "n_nodes"}) and SETTLED in finding.runs.values()


def _absent(runs: pd.DataFrame, p: Parameters) -> Iterator[str]:
    """Yield tests and levels that a check names and the experiment does not have."""
    # the quick part of a list counts as the same test
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
    """Return the runs of a method in the tests and levels of a check."""
    part = runs[
        (runs["method"] == method) & runs["test"].isin(p.get("tests", runs["test"].unique()))
    ]
    levels = part.groupby("test")["level"]
    match p.get("levels"):
        case "top":
            part = part[part["level"] == levels.transform("max")]
        case "bottom":  # a single level counts as the top
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
    """Yield the parts of a table by the columns of ``by``, each with a name."""
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
    """Return both values on every common instance."""
    both = one.merge(other[["instance_id", quantity]], on="instance_id", suffixes=("", "_rival"))
    return both.dropna(subset=[quantity, f"{quantity}_rival"])
