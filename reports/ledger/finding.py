"""The result of a check of the ledger: comparisons with a figure each, and the runs behind them.

A check takes the tables of one experiment and its parameters from the ledger. It returns a `Finding`.
Parameters: ``tests``; ``levels`` (a list, or ``top``, or ``bottom`` if there are several, or
``disturbed``, the levels above 0; levels beyond the paper's axes take part only if a list names them);
``by`` (columns; each group has a comparison); ``quantity``; ``claimed``, the side on which a figure
must lie; ``any`` (one comparison on the claimed side is enough); ``shown_only`` (shown, but not part
of the verdict); and ``cannot_refute`` (why a figure on the other side leaves the comparison open).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from reports.ledger.evidence import Evidence, Experiment, Role
from reports.ledger.intervals import Estimate, Extremes, ratio
from reports.theme import words
from workflows.compose import QUICK

Parameters = Mapping[str, Any]
GROUPING = ("test", "level")  # the default of ``by``
Cells = frozenset[tuple[str, float]]  # tests with levels
# Quantities of which a run at a limit shows only the minimum.
WORK = ("time", "n_nodes", "n_assignments", "translation_time", "translation_nodes")
# Share -> how more time can change it, and the value of the runs that it can change.
MORE_TIME = {"success": ("rises", 0.0), "search_error": ("falls", 1.0)}
FEWER_POINTS = "searches of fewer points than in the whole experiment take less time"
# Quantity -> the least that it can be (`Experiment.runs`), and whether a limit cut it.
LEAST = {"time": "translation_time"}
CUT = {"translation_time": "translation_limited", "translation_nodes": "translation_limited"}
OF_FINDING = ["run_id", "method", "test", "level", "limited"]
OF_RIVAL = ("limited", "gap_tol", "translation_limited", "translation_time", "parallel_jobs")
TIMES = ("time", "translation_time")
# Runs of one machine were made on different days, and the same work took up to this factor longer.
DAYS = 2.0
UNEQUAL_DAYS = f"times of the same work differ between days by up to a factor of {DAYS:g}"
# Quantity -> the one shown in the second column.
SECOND = {"error": "excess", "time": "n_assignments", "translation_time": "translation_nodes"}
WITH_SECOND = ("ratio", "value", "rise", "slope", "scatter", "race")  # kinds with a quantity
UNITS = {
    "error": "raw RMSE (longest sides)",
    "excess": "error above the floor (longest sides)",
    "time": "time (s)",
    "rmse": "raw RMSE (m)",
    "translation_time": "time of the search, without the rotation stage (s)",
    "translation_nodes": "boxes of the search, without the rotation stage",
    "n_nodes": "boxes",
    "n_assignments": "assignments",
    "open_gap": "relative gap at the end",
    "violation": "contradicted lower bound",
    "missed": "known pose better by more than the tolerance",
}


def between_days(
    shortest: Iterable[np.ndarray], longest: Iterable[np.ndarray], because: str = UNEQUAL_DAYS
) -> Extremes:
    """Return how small and how large a ratio of times of trials from different days can be."""
    (mine, others), (most, least) = shortest, longest
    return Extremes(ratio(mine, DAYS * others), ratio(DAYS * most, least), because)


def titled(quantity: str, *, unit: bool = True) -> str:
    """Return a quantity in words."""
    text = UNITS.get(quantity, words(quantity))
    return text if unit else text.partition(" (")[0]


@dataclass(frozen=True)
class Part:
    """One comparison of a check."""

    subject: str
    rival: str  # empty: against a threshold
    group: str  # test, source or width: with the rival, the row of the verdict
    where: str  # within the group, such as the level
    estimate: Estimate
    claimed: Parameters
    rises: bool = False  # runs at a limit could increase the figure
    falls: bool = False  # ... or decrease it
    extremes: Extremes | None = None  # between which the figure lies, if more is not known
    instances: int = 0  # of its trials
    runs: Mapping[str, bool] = field(default_factory=dict)  # run_id -> whether it ended at a limit
    shown_only: bool = False
    cannot_refute: str = ""  # why the figure can reproduce a claim only
    cannot_show: str = ""  # why it can refute a claim only
    methods: tuple[str, ...] = ()
    cells: Cells = frozenset()  # of its first table


@dataclass
class Finding:
    """The result of a check: its comparisons, the methods it used, and what is missing."""

    figure: str  # what the numbers are
    parts: list[Part] = field(default_factory=list)
    methods: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    rows: list[pd.DataFrame] = field(default_factory=list)  # of the study of bounds
    of_any: bool = False
    absent: int = 0  # planned comparisons without a value
    # Roles with choices, and the methods that must agree.
    choices: list[tuple[Role, list[str]]] = field(default_factory=list)

    def add(
        self,
        names: tuple[str, str],
        place: tuple[str, str],
        estimate: Estimate,
        claimed: Parameters,
        *tables: pd.DataFrame,
        rises: bool = False,
        falls: bool = False,
        extremes: Extremes | None = None,
    ) -> None:
        """Add a comparison of ``names`` (subject, rival) at ``place`` (group, where) over runs."""
        runs: dict[str, bool] = {}
        for table in tables:
            runs.update(zip(table["run_id"], table["limited"].astype(bool), strict=True))
            self.methods += [m for m in table["method"].unique() if m not in self.methods]
        used = tuple(dict.fromkeys(m for table in tables for m in table["method"].unique()))
        instances = len(tables[0]) if tables else estimate.n
        self.parts.append(
            Part(
                *names, *place, estimate, claimed, rises, falls, extremes, instances, runs,
                methods=used, cells=cells_of(tables[0]) if tables else frozenset(),
            )
        )  # fmt: skip

    def miss(self, what: str) -> None:
        if what not in self.missing:
            self.missing.append(what)


class Chosen(NamedTuple):
    """The runs of a role that a check compares, by the names of its methods."""

    runs: list[tuple[str, pd.DataFrame]]
    tried: list[str]  # all methods of the role
    missing: list[str]


@dataclass(frozen=True)
class Source:
    """The tables and roles that a check may use."""

    evidence: Evidence
    experiment: Experiment | None
    roles: Mapping[str, Role]
    axes: Mapping[str, float] = field(default_factory=dict)  # test -> last level the paper shows
    # Runs, a method, and the parameters of a check -> the runs that it compares; `select` if None
    select: Callable[[pd.DataFrame, str, Parameters], pd.DataFrame] | None = None
    _chosen: dict[str, Chosen] = field(init=False, default_factory=dict, repr=False)

    def runs(
        self, role: str, p: Parameters, finding: Finding
    ) -> Iterator[tuple[str, pd.DataFrame]]:
        """Yield name and selected runs of every method in a role; note a role without any."""
        # the second column differs in the quantity, which selects no runs
        key = f"{role} {sorted((name, repr(p[name])) for name in p if name != 'quantity')}"
        if key not in self._chosen:
            self._chosen[key] = self._choose(role, p)
        chosen = self._chosen[key]
        for what in chosen.missing:
            finding.miss(what)
        if self.roles[role].choices:
            finding.choices.append((self.roles[role], chosen.tried))
        yield from chosen.runs

    def _choose(self, role: str, p: Parameters) -> Chosen:
        assert self.experiment is not None
        labels = self.experiment.methods_in(self.roles[role])
        missing = [*_absent(on_axes(self.experiment.cells, p, self.axes), p)]
        tried = {label: on_axes(self.experiment.of_method(label), p, self.axes) for label in labels}
        choose = self.select or select
        chosen = [(label, choose(runs, label, p)) for label, runs in tried.items()]
        filled = [(label, runs) for label, runs in chosen if len(runs)]
        title = self.roles[role].title
        if labels and len(labels) < self.roles[role].n_choices:
            choices = " and ".join(self.roles[role].choices)
            missing.append(f"{title} with the other value of the option {choices}")
        if not filled:
            missing.append(f"{title} in these tests and levels" if labels else title)
        names = self.experiment.first["display_name"]
        missing += [
            f"{names[label]} at all of these tests and levels"
            for label, runs in filled
            if self.select is None and self._lacks_cells(runs, p)
        ]
        tried_names = [names[label] for label in labels]
        return Chosen([(names[label], runs) for label, runs in filled], tried_names, missing)

    def _lacks_cells(self, runs: pd.DataFrame, p: Parameters) -> bool:
        """Tell whether a method was not attempted at some test and level of a check."""
        assert self.experiment is not None
        cells = on_axes(self.experiment.cells, p, self.axes).assign(method="")
        return bool(cells_of(select(cells, "", {**p, "where": {}})) - cells_of(runs))

    def pairs(
        self, p: Parameters, finding: Finding
    ) -> Iterator[tuple[str, pd.DataFrame, str, pd.DataFrame]]:
        """Yield every subject with every rival."""
        for name, runs in self.runs(p["subject"], p, finding):
            for role in p["rivals"]:
                for rival, theirs in self.runs(role, p, finding):
                    yield name, runs, rival, theirs


Check = Callable[[Source, Parameters], Finding]


@dataclass(frozen=True)
class Kind:
    """A kind of check."""

    function: Check
    by: Sequence[str] = GROUPING  # the columns of its comparisons if a check names none
    of_study: bool = False  # of the study of bounds

    def __call__(self, source: Source, p: Parameters) -> Finding:
        return self.function(source, {"by": self.by, **p})


CHECKS: dict[str, Kind] = {}


def check(
    name: str, *, by: Sequence[str] = GROUPING, of_study: bool = False
) -> Callable[[Check], Check]:
    """Register a kind of check."""

    def register(function: Check) -> Check:
        CHECKS[name] = Kind(function, by, of_study)
        return function

    return register


def find(source: Source, p: Parameters) -> Finding:
    """Run a check."""
    finding = CHECKS[p["kind"]](source, p)
    finding.of_any = bool(p.get("any"))
    if p.get("shown_only"):
        finding.parts = [replace(part, shown_only=True) for part in finding.parts]
        finding.missing = []
    if reason := p.get("cannot_refute"):
        finding.parts = [replace(part, cannot_refute=reason) for part in finding.parts]
    is_part = source.experiment is not None and source.experiment.variables
    if is_part and p["kind"] == "value" and p.get("quantity") in WORK:
        finding.parts = [replace(part, cannot_show=FEWER_POINTS) for part in finding.parts]
    return finding


def second(source: Source, p: Parameters) -> tuple[str, Mapping[tuple[str, ...], Estimate]]:
    """Return title and figures of the second column: the error above the floor, or the work."""
    quantity = SECOND.get(p.get("quantity", "error"))
    if p["kind"] not in WITH_SECOND or quantity is None:
        return "", {}
    found = CHECKS[p["kind"]](source, {**p, "quantity": quantity})
    figures: dict[tuple[str, ...], Estimate] = {
        (part.subject, part.rival, part.group, part.where): part.estimate for part in found.parts
    }
    return (titled(quantity, unit=False) if figures else "", figures)


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


def on_axes(runs: pd.DataFrame, p: Parameters, axes: Mapping[str, float]) -> pd.DataFrame:
    """Return the runs at the levels that the paper shows, or all if a check lists levels."""
    if isinstance(p.get("levels"), list):
        return runs
    return runs[runs["level"] <= runs["test"].map(axes).fillna(np.inf)]


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


def of_trials(table: pd.DataFrame, *columns: str, by: str = "mean") -> np.ndarray:
    """Return a statistic of columns in each trial, (trials, columns)."""
    return table.groupby("unit")[list(columns)].agg(by).to_numpy(dtype=float)


def whole_trials(table: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Return the instances of trials without a gap if the quantity is a time, else all.

    Times are not compared where another number of jobs ran, which would change the mix of levels.
    """
    if quantity not in TIMES or table.empty:
        return table
    number = table.groupby("unit")["unit"].transform("size")
    return table[number == number.groupby(table["shape"]).transform("max")]


def cells_of(table: pd.DataFrame) -> Cells:
    """Return the tests and levels of a table."""
    return frozenset(
        zip(table["test"].tolist(), table["level"].astype(float).tolist(), strict=True)
    )


def groups(table: pd.DataFrame, p: Parameters) -> Iterator[tuple[tuple[str, str], pd.DataFrame]]:
    """Yield the parts of a table by the columns of ``by``, each with its place (group, where)."""
    by = list(p["by"])
    if not by:
        if len(table):
            yield ("all", ""), table
        return
    for (first, *rest), part in table.groupby(by, sort=False):
        names = [f"{by[at + 1]} {value:g}" if isinstance(value, float) else words(str(value))
                 for at, value in enumerate(rest)]  # fmt: skip
        yield (words(str(first)), ", ".join(names)), part


def paired(one: pd.DataFrame, other: pd.DataFrame, *quantities: str) -> pd.DataFrame:
    """Return the values of both on every common instance.

    Times are compared only if the same number of jobs ran at once.
    """
    columns = list(quantities)
    theirs = other[["instance_id", "run_id", *dict.fromkeys([*OF_RIVAL, *columns])]]
    both = one.merge(
        theirs.assign(place=np.arange(len(other))), on="instance_id", suffixes=("", "_rival")
    )
    if not set(columns).isdisjoint(TIMES):
        jobs = both[["parallel_jobs", "parallel_jobs_rival"]].fillna(0.0)
        both = both[jobs["parallel_jobs"] == jobs["parallel_jobs_rival"]]
    return both.dropna(subset=[*columns, *(f"{column}_rival" for column in columns)])


def of_rival(both: pd.DataFrame, theirs: pd.DataFrame) -> pd.DataFrame:
    """Return the rival's runs of a table that `paired` made with them, in the columns of findings."""
    return theirs[OF_FINDING].iloc[np.sort(both["place"].to_numpy())]


def limits(quantity: str, table: pd.DataFrame) -> dict[str, bool]:
    """Return how runs at a limit could change a mean, or a ratio of work if the table is paired.

    With more time, work increases, and a wrong pose can become right. The errors at the limit count.
    """
    if quantity in MORE_TIME:
        flag, before = MORE_TIME[quantity]
        return {flag: bool((table["limited"].astype(bool) & (table[quantity] == before)).any())}
    if quantity not in WORK:
        return {}
    cut = CUT.get(quantity, "limited")
    flags = {"rises": bool(table[cut].any())}
    if f"{cut}_rival" in table:
        flags["falls"] = bool(table[f"{cut}_rival"].any())
    return flags
