"""The kinds of checks that `claims.yaml` uses: each is a function with the decorator `check`.

`reports.ledger.finding` describes the common parameters.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pandas as pd

from reports.ledger import intervals
from reports.ledger.evidence import UNLIMITED
from reports.ledger.finding import (
    Finding,
    Parameters,
    Source,
    both_ways,
    check,
    groups,
    none,
    paired,
    top,
    upper,
)
from reports.theme import words

UNITS = {
    "error": "error (longest sides)",
    "time": "time (s)",
    "rmse": "RMSE (m)",
    "n_nodes": "boxes",
}
SHARES = ("success", "search_error")  # quantities of which a mean is a share
# Relative gap of a search with no lower bound above 0.
NO_BOUND = 1.0 - 1e-9
SHARED = ["dataset", "shape", "trial"]  # identify the same trial at different levels


# --- over runs ----------------------------------------------------------------------------------


@check("ratio")
def ratio(source: Source, p: Parameters) -> Finding:
    """Ratio of the means of a subject and of each rival, paired by instance.

    ``closed``: only instances that both certify and whose optimum exceeds the tolerance.
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
                        finding.missing.append(f"instances that {name} and {rival} certify")
                kept = set(both["instance_id"])
                finding.use(*(t[t["instance_id"].isin(kept)] for t in (runs, theirs)))
                for where, part in groups(both, p):
                    values = part[quantity].to_numpy(), part[f"{quantity}_rival"].to_numpy()
                    finding.add(
                        f"{name} / {rival}, {where}", intervals.ratio(*values), p["claimed"]
                    )
    return finding


@check("value")
def value(source: Source, p: Parameters) -> Finding:
    """Mean (or median, or maximum) of a quantity of every method, against a threshold."""
    quantity, statistic = p.get("quantity", "error"), p.get("statistic", "mean")
    finding = Finding(f"{statistic} {UNITS.get(quantity, words(quantity))}")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            finding.use(runs)
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


@check("rise", scenarios=both_ways(top))
def rise(source: Source, p: Parameters) -> Finding:
    """Error at a level over the error at a lower one, paired by trial: two levels, or the two highest."""
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
                finding.use(low, high)
                interval = intervals.ratio(both["error"].to_numpy(), both["error_low"].to_numpy())
                where = f"{name}, {words(str(test))} {levels[1]:g} / {levels[0]:g}"
                finding.add(where, interval, p["claimed"])
    return finding


Statistic = Callable[
    [np.ndarray, np.ndarray], np.ndarray
]  # of level means (draws × levels), levels


@check("spread", scenarios=())
def spread(source: Source, p: Parameters) -> Finding:
    """Maximum over minimum level mean of the error; with ``rivals``, divided by theirs."""
    return _over_levels(source, p, "maximum / minimum level error", _spread, np.divide)


@check("slope", scenarios=both_ways(upper))
def slope(source: Source, p: Parameters) -> Finding:
    """Slope of the error over the level; with ``rivals``, minus theirs."""
    return _over_levels(source, p, "slope of error over level", _slope, np.subtract)


def _spread(means: np.ndarray, _: np.ndarray) -> np.ndarray:
    return means.max(axis=-1) / means.min(axis=-1)


def _slope(means: np.ndarray, levels: np.ndarray) -> np.ndarray:
    centred = levels - levels.mean()
    return means @ centred / (centred @ centred)


def _over_levels(
    source: Source, p: Parameters, figure: str, statistic: Statistic, against: np.ufunc
) -> Finding:
    """A statistic of the level means, alone or against that of rivals; a part per test."""
    finding = Finding(figure)
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            rivals = [
                item for rival in p.get("rivals", []) for item in source.runs(rival, p, finding)
            ]
            finding.use(runs, *(theirs for _, theirs in rivals))
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
    """Return the statistic of the level means as a function of drawn rows of the table."""
    values, levels = table.to_numpy(), table.columns.to_numpy(dtype=float)

    def of(rows: np.ndarray) -> np.ndarray:
        with warnings.catch_warnings():
            # NaN is intended for a level at which no drawn row has a value
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
    """Return a column per level and a row per trial; a row per instance if levels are not paired."""
    paired_levels = p.get("paired_levels", True)
    index = SHARED if paired_levels else "instance_id"
    table = runs.pivot_table(index=index, columns="level", values=p.get("quantity", "error"))
    table = table.dropna() if paired_levels else table
    return table if table.shape[1] > 1 and len(table) else None


@check("trend", scenarios=())
def trend(source: Source, p: Parameters) -> Finding:
    """Spearman's rank correlation of time or boxes with the level."""
    finding = Finding("rank correlation with the level")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            finding.use(runs)
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

    If only one search has a bound above 0, the comparison uses its smallest gap, and the other search
    counts with its whole time.
    """
    finding = Finding("ratio of mean time to equal gap")
    assert source.experiment is not None
    traces = source.experiment.tables.traces
    traces = traces[traces["upper_bound"] > 0]
    gap = (traces["upper_bound"] - traces["lower_bound"]) / traces["upper_bound"]
    histories = dict(list(traces.assign(gap=gap).groupby("run_id")))
    never = pd.Series([0.0])  # any level: a scenario applies to all searches without a bound
    factors = [
        UNLIMITED if scenario(never).all() else 1.0 for scenario in source.scenarios or (none, none)
    ]
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
                    finding.use(part[part["run_id"].isin(set(kept))])
                if times:
                    mine, other = np.array(list(times.values())).T
                    finding.add(f"{name} / {rival}", intervals.ratio(mine, other), p["claimed"])
                else:
                    finding.missing.append(f"bound histories of {rival}")
    return finding


def _times_to_equal_gap(
    one: pd.DataFrame, other: pd.DataFrame, factors: Sequence[float]
) -> list[float] | None:
    """Return the seconds to the gap at which two searches are compared; None if neither has a bound.

    A search without a bound counts its whole time, multiplied by its factor in `factors`.
    """
    smallest = [one["gap"].min(), other["gap"].min()]
    reached = max(smallest) if max(smallest) < NO_BOUND else min(smallest)
    if reached >= NO_BOUND:
        return None
    times = []
    for history, minimum, factor in zip((one, other), smallest, factors, strict=True):
        if minimum <= reached:
            seconds = float(history.loc[history["gap"] <= reached, "time_s"].iloc[0])
        else:
            seconds = factor * float(history["time_s"].iloc[-1])
        times.append(max(seconds, 1e-6))
    return times


@check("regret")
def regret(source: Source, p: Parameters) -> Finding:
    """Share of the instances certified by a reference whose optimum the subject reaches."""
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
            finding.use(runs[runs["instance_id"].isin(set(both["instance_id"]))])
            if len(both):
                interval = intervals.share(within.to_numpy(dtype=float))
                finding.add(f"{name} where {against} certified", interval, p["claimed"])
            else:
                finding.missing.append(f"runs that {against} certified")
    return finding


# --- over the study of bounds -------------------------------------------------------------------


@check("boxes", of_study=True)
def boxes(source: Source, p: Parameters) -> Finding:
    """Share of the boxes in which one bound is at least another one; a part per width."""
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
    """Ratio of gaps after the number of assignments that both searches of an instance solved."""
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
