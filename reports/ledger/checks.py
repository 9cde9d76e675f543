"""The kinds of checks that `claims.yaml` uses. A new kind is a function here with a name.

A check takes the tables of one experiment and its parameters from the ledger, and returns a
`Finding`: parts with a figure and an interval each, and which runs they rest on. Common parameters:
``tests``, ``levels`` (a list, or ``top``, ``bottom`` of several, ``disturbed``: above 0; levels beyond
the paper's own axes only where a list names them), ``by`` (columns: a part per group), ``any`` (one part
is enough), and ``claimed``, the side on which a figure has to lie.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from reports.ledger import intervals
from reports.ledger.evidence import FOR_EVER, QUICK, Evidence, Experiment, Role, imagined
from reports.ledger.intervals import Interval
from reports.theme import words

Parameters = Mapping[str, Any]
UNITS = {
    "error": "error (longest sides)",
    "time": "time (s)",
    "rmse": "RMSE (m)",
    "n_nodes": "boxes",
}
SHARES = ("success", "search_error")  # quantities of which a mean is a share
LIMITED, SETTLED = "limited", "settled"  # ends of runs; settled: at a limit, but proven optimal
BEST_FIRST = (intervals.REPRODUCED, intervals.OPEN, intervals.NOT)
# Relative gap of a search that has no bound but that squares are not negative.
NO_BOUND = 1.0 - 1e-9
SHARED = ["dataset", "shape", "trial"]  # what draws of different levels have in common


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


def _none(levels: pd.Series) -> pd.Series:
    return levels > np.inf


def _top(levels: pd.Series) -> pd.Series:
    return levels == levels.max()


def _upper(levels: pd.Series) -> pd.Series:
    return levels > levels.unique().mean()


def _both(fate: Fate) -> tuple[Fate, Fate]:
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
    name: str, *, of_study: bool = False, fates: tuple[Fate, ...] = _both(_none)
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


# --- over runs ----------------------------------------------------------------------------------


@check("ratio")
def ratio(source: Source, p: Parameters) -> Finding:
    """Ratio of means of a subject and each rival, paired by instance.

    ``closed``: of instances that both prove, by more than that squares are not negative.
    """
    quantity: str = p.get("quantity", "error")
    finding = Finding(f"ratio of mean {UNITS.get(quantity, words(quantity)).partition(' (')[0]}")
    subjects = [item for role in _list(p["subject"]) for item in source.runs(role, p, finding)]
    for name, runs in subjects:
        for role in p["rivals"]:
            for rival, theirs in source.runs(role, p, finding):
                both = paired(runs, theirs, quantity)
                if p.get("closed"):
                    closed = set(theirs.loc[theirs["certified"], "instance_id"])
                    proven = both["certified"] & both["instance_id"].isin(closed)
                    both = both[proven & (both["objective"] > both["gap_tol"])]
                    if both.empty:
                        finding.missing.append(f"instances that {name} and {rival} close")
                kept = set(both["instance_id"])
                finding.rest_on(*(t[t["instance_id"].isin(kept)] for t in (runs, theirs)))
                for where, part in groups(both, p):
                    values = part[quantity].to_numpy(), part[f"{quantity}_rival"].to_numpy()
                    finding.add(
                        f"{name} / {rival}, {where}", intervals.ratio(*values), p["claimed"]
                    )
    return finding


@check("value")
def value(source: Source, p: Parameters) -> Finding:
    """Mean (or median, or greatest value) of a quantity of every method against a threshold."""
    quantity, statistic = p.get("quantity", "error"), p.get("statistic", "mean")
    finding = Finding(f"{statistic} {UNITS.get(quantity, words(quantity))}")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            finding.rest_on(runs)
            for where, part in groups(runs, p):
                values = part[quantity].to_numpy(dtype=float)
                values = values[np.isfinite(values)]
                if len(values):
                    if statistic == "mean" and quantity in SHARES:
                        interval = intervals.share(values)
                    else:
                        interval = getattr(intervals, statistic)(values)
                    finding.add(f"{name}, {where}", interval, p["claimed"])
    return finding


@check("rise", fates=_both(_top))
def rise(source: Source, p: Parameters) -> Finding:
    """Error at a level over that at a lower one, paired by trial. Levels: two, or top and the next."""
    finding = Finding("error at the higher level / at the lower")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            for test, part in runs.groupby("test", sort=False):
                levels = sorted(part["level"].unique())[-2:]
                if len(levels) < 2:
                    continue
                low, high = (part[part["level"] == level] for level in levels)
                both = high.merge(low[[*SHARED, "error"]], on=SHARED, suffixes=("", "_low"))
                if both.empty:
                    continue
                finding.rest_on(low, high)
                interval = intervals.ratio(both["error"].to_numpy(), both["error_low"].to_numpy())
                where = f"{name}, {words(str(test))} {levels[1]:g} / {levels[0]:g}"
                finding.add(where, interval, p["claimed"])
    return finding


Statistic = Callable[
    [np.ndarray, np.ndarray], np.ndarray
]  # of level means (draws × levels), levels


@check("spread", fates=())
def spread(source: Source, p: Parameters) -> Finding:
    """Greatest over least level mean of the error; with ``rivals``, that of the subject over theirs."""
    return _over_levels(source, p, "greatest / least level error", _spread, np.divide)


@check("slope", fates=_both(_upper))
def slope(source: Source, p: Parameters) -> Finding:
    """Slope of the error over the level; with ``rivals``, that of the subject less theirs."""
    return _over_levels(source, p, "slope of error over level", _slope, np.subtract)


def _spread(means: np.ndarray, _: np.ndarray) -> np.ndarray:
    return means.max(axis=-1) / means.min(axis=-1)


def _slope(means: np.ndarray, levels: np.ndarray) -> np.ndarray:
    centred = levels - levels.mean()
    return means @ centred / (centred @ centred)


def _over_levels(
    source: Source, p: Parameters, figure: str, statistic: Statistic, against: np.ufunc
) -> Finding:
    """A statistic of the level means, alone or against that of rivals, a part per test."""
    finding = Finding(figure)
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            rivals = [
                item for rival in p.get("rivals", []) for item in source.runs(rival, p, finding)
            ]
            finding.rest_on(runs, *(theirs for _, theirs in rivals))
            for test, part in runs.groupby("test", sort=False):
                mine = _by_level(part, p)
                if mine is None:
                    continue
                if not p.get("rivals"):
                    found = intervals.bootstrap(_of_rows(statistic, mine), len(mine))
                    finding.add(f"{name}, {words(str(test))}", found, p["claimed"])
                for rival, theirs in rivals:
                    table = _by_level(theirs[theirs["test"] == test], p)
                    if table is None or list(table) != list(mine):
                        continue
                    common = mine.index.intersection(table.index)
                    one, other = (_of_rows(statistic, t.loc[common]) for t in (mine, table))
                    both = partial(_compared, against, one, other)
                    where = f"{name} against {rival}, {words(str(test))}"
                    finding.add(where, intervals.bootstrap(both, len(common)), p["claimed"])
    return finding


def _of_rows(statistic: Statistic, table: pd.DataFrame) -> Callable[[np.ndarray], np.ndarray]:
    """The statistic of the level means, for drawn rows of the table."""
    values, levels = table.to_numpy(), table.columns.to_numpy(dtype=float)

    def of(rows: np.ndarray) -> np.ndarray:
        with warnings.catch_warnings():
            # a level at which no drawn row has a value: NaN is what is wanted
            warnings.filterwarnings("ignore", "Mean of empty slice", RuntimeWarning)
            return statistic(np.nanmean(values[rows], axis=1), levels)

    return of


def _compared(
    against: np.ufunc,
    one: Callable[[np.ndarray], np.ndarray],
    other: Callable[[np.ndarray], np.ndarray],
    rows: np.ndarray,
) -> np.ndarray:
    return against(one(rows), other(rows))


def _by_level(runs: pd.DataFrame, p: Parameters) -> pd.DataFrame | None:
    """A column per level and a row per trial, drawn together; without pairs, a row per instance."""
    paired_levels = p.get("paired_levels", True)
    index = SHARED if paired_levels else "instance_id"
    table = runs.pivot_table(index=index, columns="level", values=p.get("quantity", "error"))
    table = table.dropna() if paired_levels else table
    return table if table.shape[1] > 1 and len(table) else None


@check("trend", fates=())
def trend(source: Source, p: Parameters) -> Finding:
    """Spearman's rank correlation of time or work with the level."""
    finding = Finding("rank correlation with the level")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            finding.rest_on(runs)
            for quantity in p["quantities"]:
                for test, part in runs.dropna(subset=quantity).groupby("test", sort=False):
                    if part["level"].nunique() < 2 or part[quantity].nunique() < 2:
                        continue
                    ranks = part[["level", quantity]].rank().to_numpy()
                    finding.add(f"{name}, {words(str(test))}, {words(quantity)}",
                                intervals.bootstrap(partial(_correlations, ranks), len(part)),
                                p["claimed"])  # fmt: skip
    return finding


def _correlations(ranks: np.ndarray, rows: np.ndarray) -> np.ndarray:
    drawn = ranks[rows]
    centred = drawn - drawn.mean(axis=1, keepdims=True)
    above = (centred[..., 0] * centred[..., 1]).sum(axis=1)
    below = np.sqrt((centred[..., 0] ** 2).sum(axis=1) * (centred[..., 1] ** 2).sum(axis=1))
    return np.divide(above, below, out=np.zeros_like(above), where=below > 0)


@check("race")
def race(source: Source, p: Parameters) -> Finding:
    """Ratio of times to the smallest relative gap that both searches of an instance reached.

    Where one of them came to no bound at all: to the gap that the other reached, and it needs at least
    the time that it took.
    """
    finding = Finding("ratio of mean time to equal gap")
    assert source.experiment is not None
    traces = source.experiment.tables.traces
    traces = traces[traces["upper_bound"] > 0]
    gap = (traces["upper_bound"] - traces["lower_bound"]) / traces["upper_bound"]
    histories = dict(list(traces.assign(gap=gap).groupby("run_id")))
    never = pd.Series([0.0])  # a level: what becomes of searches without a bound is that of all
    factors = [FOR_EVER if fate(never).all() else 1.0 for fate in source.fates or (_none, _none)]
    for name, runs in source.runs(p["subject"], p, finding):
        for role in p["rivals"]:
            for rival, theirs in source.runs(role, p, finding):
                both = paired(runs, theirs, "run_id")
                both = both[both["run_id"].isin(histories) & both["run_id_rival"].isin(histories)]
                times = {
                    (mine, other): found
                    for mine, other in zip(both["run_id"], both["run_id_rival"], strict=True)
                    if (found := _times_to_equal_gap(histories[mine], histories[other], factors))
                }
                for part, kept in zip((runs, theirs), zip(*times, strict=True), strict=False):
                    finding.rest_on(part[part["run_id"].isin(set(kept))])
                if times:
                    mine, other = np.array(list(times.values())).T
                    finding.add(f"{name} / {rival}", intervals.ratio(mine, other), p["claimed"])
                else:
                    finding.missing.append(f"bound histories of {rival}")
    return finding


def _times_to_equal_gap(
    one: pd.DataFrame, other: pd.DataFrame, factors: Sequence[float]
) -> list[float] | None:
    """Seconds to the gap at which two searches are compared; None: neither has a bound.

    `factors`: of the whole time of a search that has none, which might have needed that much longer.
    """
    smallest = [one["gap"].min(), other["gap"].min()]
    reached = max(smallest) if max(smallest) < NO_BOUND else min(smallest)
    if reached >= NO_BOUND:
        return None
    times = []
    for history, least, factor in zip((one, other), smallest, factors, strict=True):
        if least <= reached:
            seconds = float(history.loc[history["gap"] <= reached, "time_s"].iloc[0])
        else:
            seconds = factor * float(history["time_s"].iloc[-1])
        times.append(max(seconds, 1e-6))
    return times


@check("regret")
def regret(source: Source, p: Parameters) -> Finding:
    """Share of instances that a reference closed where the subject's objective is within its gap."""
    finding = Finding("share within the tolerance")
    for name, runs in source.runs(p["subject"], p, finding):
        for against, theirs in source.runs(p["reference"], p, finding):
            closed = theirs[theirs["certified"]]
            both = runs.merge(
                closed[["instance_id", "objective", "gap_tol"]],
                on="instance_id",
                suffixes=("", "_ref"),
            )
            within = both["objective"] - both["objective_ref"] <= both["gap_tol_ref"] * (1 + 1e-9)
            finding.rest_on(runs[runs["instance_id"].isin(set(both["instance_id"]))])
            if len(both):
                interval = intervals.share(within.to_numpy(dtype=float))
                finding.add(f"{name} where {against} closed", interval, p["claimed"])
            else:
                finding.missing.append(f"runs that {against} closed")
    return finding


# --- over the study of bounds -------------------------------------------------------------------


@check("boxes", of_study=True)
def boxes(source: Source, p: Parameters) -> Finding:
    """Share of the same boxes in which one bound is at least the others, a part per width."""
    finding = Finding("share of boxes")
    table = source.evidence.study["boxes"].dropna(subset="value")
    axes = ["instance", "place", "draw", "width"]
    wide = table.pivot_table(index=axes, columns="bound", values="value").reset_index()
    if pattern := p.get("instances"):
        wide = wide[wide["instance"].str.startswith(pattern)]
    for rival in p["rivals"]:
        if not {p["subject"], rival} <= set(wide.columns):
            finding.missing.append(f"bound {rival}")
            continue
        both = wide.dropna(subset=[p["subject"], rival])
        above = both[p["subject"]] >= both[rival] - 1e-9 * (1 + both[rival].abs())
        for width, part in above.groupby(both["width"]):
            where = f"{p['subject']} ≥ {rival}, width {width:.2g}"
            finding.add(where, intervals.share(part.to_numpy(dtype=float)), p["claimed"])
    return finding


@check("orders", of_study=True)
def orders(source: Source, p: Parameters) -> Finding:
    """Mean slope of log loss over log box width, over instances and places of boxes."""
    finding = Finding("slope of log loss over log width")
    table = source.evidence.study["orders"].dropna(subset="order")
    for name, claimed in p["bounds"].items():
        values = table.loc[table["bound"] == name, "order"].to_numpy()
        if len(values):
            finding.add(name, intervals.mean(values), claimed)
        else:
            finding.missing.append(f"bound {name}")
    return finding


@check("work", of_study=True)
def work(source: Source, p: Parameters) -> Finding:
    """Ratio of gaps after as many assignments as both searches of an instance solved."""
    finding = Finding("ratio of mean gap at equal assignments")
    table = source.evidence.study["searches"]
    for rival in p["rivals"]:
        gaps = []
        for _, part in table.groupby("instance", sort=False):
            mine, theirs = (part[part["bound"] == name] for name in (p["subject"], rival))
            if len(mine) and len(theirs):
                shared = min(mine["n_assignments"].max(), theirs["n_assignments"].max())
                gaps.append([h.loc[h["n_assignments"] <= shared, "gap"].iloc[-1]
                             if (h["n_assignments"] <= shared).any() else h["gap"].iloc[0]
                             for h in (mine, theirs)])  # fmt: skip
        if gaps:
            above, below = np.array(gaps).T
            finding.add(f"{p['subject']} / {rival}", intervals.ratio(above, below), p["claimed"])
        else:
            finding.missing.append(f"bound {rival}")
    return finding


def _list(value: str | Sequence[str]) -> list[str]:
    return [value] if isinstance(value, str) else list(value)
