"""The kinds of checks over errors and other quantities of runs.

Each is a function with the decorator `check`. `reports.ledger.finding` describes the common parameters,
`reports.ledger.checks_work` has the checks of time and proof, `reports.ledger.checks_study` those of the
study of bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations

import numpy as np
import pandas as pd

from reports.ledger import intervals
from reports.ledger.evidence import SHARED
from reports.ledger.finding import (
    LEAST,
    TIMES,
    UNEQUAL_DAYS,
    WORK,
    Finding,
    Parameters,
    Source,
    between_days,
    check,
    groups,
    limits,
    of_rival,
    of_trials,
    paired,
    titled,
    whole_trials,
)
from reports.theme import words

ROTATION = "depends on the rotation stage, which is a reconstruction"
SHARES = ("success", "search_error")  # quantities of which a mean is a share
# An error is low within this factor of the fit to the true pairs, or below this error above the floor.
LOW_FACTOR, LOW_EXCESS = 1.1, 0.02


@check("ratio")
def ratio(source: Source, p: Parameters) -> Finding:
    """Ratio of the means of a subject and of each rival, paired by instance.

    ``closed``: only instances that both certify and whose optimum exceeds the tolerance.
    """
    quantity: str = p.get("quantity", "error")
    finding = Finding(f"ratio of mean {titled(quantity, unit=False)}")
    for name, runs, rival, theirs in source.pairs(p, finding):
        both = paired(runs, theirs, quantity)
        if p.get("closed"):
            closed = set(theirs.loc[theirs["certified"], "instance_id"])
            proven = both["certified"] & both["instance_id"].isin(closed)
            both = both[proven & (both["objective"] > both["gap_tol"])]
            if both.empty:
                finding.miss(f"instances that {name} and {rival} certify")
        for place, part in groups(both, p):
            part = whole_trials(part, quantity)
            if part.empty:
                continue
            sums = of_trials(part, quantity, f"{quantity}_rival", by="sum")
            found = intervals.ratio(*sums.T)
            used, flags = (part, of_rival(part, theirs)), limits(quantity, part)
            finding.add(
                (name, rival), place, found, p["claimed"], *used,
                extremes=_extreme_ratios(part, quantity), **flags,
            )  # fmt: skip
    return finding


def _extreme_ratios(part: pd.DataFrame, quantity: str) -> intervals.Extremes | None:
    """Return how small and how large a ratio of times can be.

    The rotation stage of either method, which we reconstructed, may take no time, and the two methods may
    have run on days on which the same work took more or less time (`DAYS`).
    """
    if quantity not in TIMES:
        return None
    mine, others = of_trials(part, quantity, f"{quantity}_rival", by="sum").T
    if quantity not in LEAST:
        return between_days((mine, others), (mine, others))
    rest = LEAST[quantity]
    least, their_least = of_trials(part, rest, f"{rest}_rival", by="sum").T
    is_whole = (least == mine).all() and (their_least == others).all()
    because = UNEQUAL_DAYS if is_whole else f"{ROTATION}; {UNEQUAL_DAYS}"
    return between_days((least, others), (mine, their_least), because)


@check("value")
def value(source: Source, p: Parameters) -> Finding:
    """Mean (or median, or maximum) of a quantity of every method, against a threshold."""
    quantity, statistic = p.get("quantity", "error"), p.get("statistic", "mean")
    is_share = statistic == "mean" and quantity in SHARES
    finding = Finding(f"{words(quantity)} rate" if is_share else f"{statistic} {titled(quantity)}")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            valued = runs.dropna(subset=quantity)
            for test in runs["test"].unique():
                if not valued["test"].eq(test).any():
                    finding.miss(f"a {titled(quantity, unit=False)} of {name} in {words(test)}")
            for place, part in groups(valued, p):
                of_trial = "max" if statistic == "maximum" else "mean"
                (values,) = of_trials(part, quantity, by=of_trial).T
                flags: dict[str, bool] = {}
                between: intervals.Extremes | None = None
                if is_share:
                    found: intervals.Estimate = intervals.share(values)
                    flags = limits(quantity, part)
                elif statistic == "median" and quantity in WORK:
                    found = intervals.median(values)
                    work = part.assign(work=np.where(part["limited"], np.inf, part[quantity]))
                    longest = intervals.median(of_trials(work, "work")[:, 0])
                    between = intervals.Extremes(found, longest, intervals.TIME_OUTS)
                else:
                    found = getattr(intervals, statistic)(values)
                    flags = limits(quantity, part)
                finding.add(
                    (name, ""), place, found, p["claimed"], part, extremes=between, **flags,
                )  # fmt: skip
    return finding


@check("low")
def low(source: Source, p: Parameters) -> Finding:
    """Mean error as a multiple of what counts as low; at most 1 is low.

    An error is low if the mean raw RMSE is within `LOW_FACTOR` of the mean RMSE of the fit to the true
    pairs, or if the mean error above the floor is below `LOW_EXCESS`.
    """
    finding = Finding("mean error / what counts as low")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            for place, part in groups(runs, p):
                found = intervals.of_means(_allowance, of_trials(part, "error", "floor", "excess"))
                finding.add((name, ""), place, found, p["claimed"], part)
    return finding


def _allowance(means: np.ndarray) -> np.ndarray:
    error, floor, excess = means.T
    over_fit = np.divide(
        error, LOW_FACTOR * floor, out=np.full_like(error, np.inf), where=floor > 0
    )
    return np.minimum(over_fit, excess / LOW_EXCESS)


@check("rise", by=("test",))
def rise(source: Source, p: Parameters) -> Finding:
    """Error at the highest level over the error at the lowest one, paired by trial.

    ``within``: the largest ratio between two levels of which the higher is at most so many times the
    lower. An error may already be large at the last level but one, so the last step alone shows no rise.
    """
    quantity = p.get("quantity", "error")
    finding = Finding(f"mean {titled(quantity, unit=False)} at the higher level / at the lower")
    within = p.get("within")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            for test, part in runs.groupby("test", sort=False):
                if part["level"].nunique() < 2:
                    finding.miss(f"a second level of {words(str(test))}")
                    continue
                if (table := _by_level(part, quantity)) is not None:
                    statistic = (
                        _overall
                        if within is None
                        else _steepest(table.columns.to_numpy(float), within)
                    )
                    found = intervals.of_means(statistic, table.to_numpy())
                    ends = f"level {table.columns[-1]:g} / {table.columns[0]:g}"
                    place = words(str(test)), ends if within is None else "largest rise"
                    finding.add((name, ""), place, found, p["claimed"], part)
    return finding


def _overall(means: np.ndarray) -> np.ndarray:
    return means[:, -1] / means[:, 0]


def _steepest(levels: np.ndarray, within: float) -> Statistic:
    pairs = combinations(range(len(levels)), 2)
    near = [(a, b) for a, b in pairs if levels[b] <= within * levels[a] * (1 + 1e-9)]
    low, high = np.array(near).T
    return lambda means: (means[:, high] / means[:, low]).max(axis=1)


# Statistic of the means of a table with a column per level.
Statistic = Callable[[np.ndarray], np.ndarray]


@check("slope", by=("test",))
def slope(source: Source, p: Parameters) -> Finding:
    """Slope of the mean error over the level; with ``rivals``, minus theirs, paired by trial.

    With ``paired_levels: false``, the levels do not share trials: the slope is that over instances.
    """
    quantity = p.get("quantity", "error")
    finding = Finding(f"slope of mean {titled(quantity, unit=False)} over level")
    finding.figure += ", minus the rival's" * bool(p.get("rivals"))
    by = list(p["by"])
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            if not p.get("rivals"):
                for place, part in groups(runs.dropna(subset=quantity), {"by": by}):
                    if not p.get("paired_levels", True):
                        found = _slope_of_instances(part, quantity)
                    elif (table := _by_level(part, quantity)) is not None:
                        found = intervals.of_means(*_slopes(table))
                    else:
                        continue
                    finding.add((name, ""), place, found, p["claimed"], part)
            for rival_role in p.get("rivals", ()):
                for rival, theirs in source.runs(rival_role, p, finding):
                    for place, part, other, tables in _both_by_level(runs, theirs, by, quantity):
                        (one, mine), (two, others) = (_slopes(table) for table in tables)
                        columns = np.hstack([mine, others])
                        found = intervals.of_means(partial(_difference, one, two), columns)
                        finding.add((name, rival), place, found, p["claimed"], part, other)
    return finding


def _difference(one: Statistic, two: Statistic, means: np.ndarray) -> np.ndarray:
    """Return the difference of two statistics, each of one half of the columns."""
    mine, others = np.split(means, 2, axis=1)
    return one(mine) - two(others)


def _slopes(table: pd.DataFrame) -> tuple[Statistic, np.ndarray]:
    """Return the slope over levels as a statistic of means, and the columns to average."""
    levels = table.columns.to_numpy(dtype=float)
    centred = levels - levels.mean()
    return lambda means: means @ centred / (centred @ centred), table.to_numpy()


def _slope_of_instances(part: pd.DataFrame, quantity: str) -> intervals.Figure:
    """Return the least-squares slope of a quantity over the level."""
    x, y = part["level"] - part["level"].mean(), part[quantity]
    terms = part.assign(x=x, y=y, xy=x * y, xx=x * x)
    return intervals.of_means(_least_squares, of_trials(terms, "x", "y", "xy", "xx"))


def _least_squares(means: np.ndarray) -> np.ndarray:
    x, y, xy, xx = means.T
    return (xy - x * y) / (xx - x**2)


@check("scatter", by=("test",))
def scatter(source: Source, p: Parameters) -> Finding:
    """Standard deviation of the error over the trials of a level, over the rival's."""
    quantity = p.get("quantity", "error")
    finding = Finding(
        f"ratio of the standard deviation of {titled(quantity, unit=False)} over trials"
    )
    for name, runs, rival, theirs in source.pairs(p, finding):
        for place, part, other, tables in _both_by_level(runs, theirs, ["test"], quantity):
            values = np.hstack([_within_shapes(table) for table in tables])
            found = intervals.of_means(_deviations, np.hstack([values, values**2]))
            finding.add((name, rival), place, found, p["claimed"], part, other)
    return finding


def _within_shapes(table: pd.DataFrame) -> np.ndarray:
    """Return the deviations of a table with a column per level from the means of each shape."""
    means = table.groupby(["dataset", "shape"]).transform("mean")
    return (table - means).to_numpy()


def _deviations(means: np.ndarray) -> np.ndarray:
    """Return the ratio of standard deviations within levels, from means of values and of squares."""
    first, squares = np.split(means, 2, axis=1)
    mine, others = np.split(np.maximum(squares - first**2, 0.0), 2, axis=1)
    return np.sqrt(mine.sum(axis=1) / others.sum(axis=1))


def _both_by_level(
    runs: pd.DataFrame, theirs: pd.DataFrame, by: list[str], quantity: str
) -> Iterator[tuple[tuple[str, str], pd.DataFrame, pd.DataFrame, list[pd.DataFrame]]]:
    """Yield place, runs and tables per level of two methods, over their common trials."""
    for place, part in groups(runs, {"by": by}):
        other = theirs[theirs["test"].isin(part["test"].unique())]
        mine, others = (_by_level(each, quantity) for each in (part, other))
        if mine is None or others is None or list(mine) != list(others):
            continue
        common = mine.index.intersection(others.index)
        if len(common):
            yield place, part, other, [mine.loc[common], others.loc[common]]


def _by_level(runs: pd.DataFrame, quantity: str) -> pd.DataFrame | None:
    """Return a column per level and a row per trial."""
    table = runs.pivot_table(index=SHARED, columns="level", values=quantity).dropna()
    return table if table.shape[1] > 1 and len(table) else None
