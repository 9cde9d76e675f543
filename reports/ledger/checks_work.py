"""The kinds of checks over time, work and proof.

The time and boxes of a run at a limit are minima of what a finished run would take. Each check states
how such runs could change its figure (`Part.rises`, `Part.falls`). A figure that could rise is never
shown to be small.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from reports.ledger import intervals
from reports.ledger.finding import (
    CUT,
    DAYS,
    TIMES,
    UNEQUAL_DAYS,
    Finding,
    Parameters,
    Source,
    between_days,
    check,
    groups,
    of_rival,
    of_trials,
    paired,
    titled,
    whole_trials,
)
from reports.tables import BOUNDS, stored_positions

if TYPE_CHECKING:
    import polars as pl

# Relative gap from which a search counts as having no lower bound above 0.
NO_BOUND = 1.0 - 1e-9


@check("trend", by=("test",))
def trend(source: Source, p: Parameters) -> Finding:
    """Spearman's rank correlation of work with the level.

    A run at a limit ranks above all that ended. How such runs rank among themselves is not known: the
    correlation lies between those with the highest level first and last.
    """
    finding = Finding("rank correlation with the level")
    for role in p["methods"]:
        for name, runs in source.runs(role, p, finding):
            for quantity in p["quantities"]:
                for (test, _), part in groups(runs.dropna(subset=quantity), {"by": ["test"]}):
                    if part["level"].nunique() < 2:
                        finding.miss(f"a second level of {test}")
                        continue
                    cut = part[CUT.get(quantity, "limited")].astype(bool)
                    level, unit = part["level"], part["unit"]
                    found, least, most = (
                        _rank_correlation(
                            level, part[quantity].mask(cut, np.inf), cut * order, unit
                        )
                        for order in (0.0 * level, -level, level)
                    )
                    between = intervals.Extremes(least, most, intervals.TIME_OUTS)
                    finding.add(
                        (name, ""), (test, titled(quantity, unit=False)), found, p["claimed"], part,
                        extremes=between if cut.any() else None,
                    )  # fmt: skip
    return finding


def _rank_correlation(
    level: pd.Series, work: pd.Series, then: pd.Series, unit: pd.Series
) -> intervals.Figure:
    """Return the correlation of the ranks of the levels and of the work, ties ordered by `then`.

    The levels of a trial share its pose, so only trials are independent.
    """
    order = pd.Series(list(zip(work, then, strict=True)), work.index)
    y_ranks = order.map({key: at for at, key in enumerate(sorted(set(order)))}).rank()
    x, y = (ranks.to_numpy() - ranks.mean() for ranks in (level.rank(), y_ranks))
    terms = pd.DataFrame(np.column_stack([x, y, x * y, x**2, y**2]), index=level.index)
    return intervals.of_means(_correlation, terms.groupby(unit).mean().to_numpy())


def _correlation(means: np.ndarray) -> np.ndarray:
    x, y, xy, xx, yy = means.T
    below = np.sqrt(np.maximum((xx - x**2) * (yy - y**2), 0.0))
    return np.divide(xy - x * y, below, out=np.zeros_like(xy), where=below > 0)


@check("race", by=("test",))
def race(source: Source, p: Parameters) -> Finding:
    """Ratio of time, or assignments, to the smallest relative gap that both searches reached.

    If only one search has a bound above 0, the comparison uses its smallest gap, and the other search
    counts with its whole time: it needed at least that.
    """
    counter = {"time": "time_s"}.get(p.get("quantity", "time"), "n_assignments")
    finding = Finding(
        f"ratio of mean {titled(p.get('quantity', 'time'), unit=False)} to an equal gap"
    )
    assert source.experiment is not None
    traces = source.experiment.tables.scan_traces()
    timed = ["time"] if counter == "time_s" else []  # known for the runs of one machine
    for name, runs, rival, theirs in source.pairs(p, finding):
        both = paired(runs, theirs, *timed)
        histories = _histories(traces, [*both["run_id"], *both["run_id_rival"]], counter)
        met = [
            _work_to_equal_gap(histories.get(mine), histories.get(other))
            for mine, other in zip(both["run_id"], both["run_id_rival"], strict=True)
        ]
        columns = ["mine", "other", "mine_open", "other_open"]
        both[columns] = np.array([each or (np.nan,) * 4 for each in met]).reshape(-1, 4)
        count = int(both["mine"].isna().sum())
        if count == len(both):
            finding.miss(f"bound histories of {rival}")
        elif count:
            instances = f"{count} of {len(both)} instances"
            finding.miss(f"a bound above 0 of {name} or {rival} for {instances}")
        both = both.dropna(subset=columns)
        for place, part in groups(both, p):
            sums = of_trials(part, "mine", "other", by="sum").T
            found = intervals.ratio(*sums)
            finding.add(
                (name, rival), place, found, p["claimed"], part, of_rival(part, theirs),
                extremes=between_days(sums, sums) if timed else None,
                rises=bool(part["mine_open"].any()), falls=bool(part["other_open"].any()),
            )  # fmt: skip
    return finding


def _histories(
    traces: pl.LazyFrame, run_ids: list[str], counter: str
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return relative gaps, at most 1, and the work spent until then, of some runs."""
    import polars as pl

    own = pl.LazyFrame({"run_id": run_ids}, {"run_id": pl.String})
    known = traces.join(own, on="run_id", how="semi", maintain_order="left")
    events = known.select("run_id", "stage", *BOUNDS, counter).collect().to_pandas()
    stage, bounds = events["stage"].to_numpy(), events[list(BOUNDS)].to_numpy(dtype=float)
    spent = events[counter].to_numpy(dtype=float)
    found = {}
    for run, rows in events.groupby("run_id", sort=False).indices.items():
        # histories of archived runs are thinned, so all are
        kept = rows[stored_positions(stage[rows], bounds[rows])]
        lower, upper = bounds[kept].T
        if (is_known := upper > 0.0).any():
            gap = (upper - lower)[is_known] / upper[is_known]
            found[str(run)] = np.minimum(gap, 1.0), spent[kept][is_known]
    return found


def _work_to_equal_gap(
    one: tuple[np.ndarray, np.ndarray] | None, other: tuple[np.ndarray, np.ndarray] | None
) -> tuple[float, ...] | None:
    """Return the work of two searches to the gap at which they are compared, and who did not reach it.

    None if neither has a bound.
    """
    if one is None or other is None:
        return None
    smallest = [one[0].min(), other[0].min()]
    reached = max(smallest) if max(smallest) < NO_BOUND else min(smallest)
    if reached >= NO_BOUND:
        return None
    work, late = [], []
    for (gap, spent), minimum in zip((one, other), smallest, strict=True):
        late.append(float(minimum > reached))
        at = len(gap) - 1 if late[-1] else int((gap <= reached).argmax())
        work.append(max(float(spent[at]), 1e-6))
    return (*work, *late)


@check("regret", by=("test",))
def regret(source: Source, p: Parameters) -> Finding:
    """Share of the instances certified by a reference whose optimum the subject reaches.

    It is reached within the tolerances of both. A run without a pose is a miss. More time could turn a
    miss at a limit into a hit, but no hit into a miss.
    """
    finding = Finding("share within the tolerance")
    for name, own in source.runs(p["subject"], p, finding):
        runs = own.assign(objective=own["objective"].mask(own["verdict"].eq("no_pose"), np.inf))
        for against, theirs in source.runs(p["reference"], p, finding):
            both = paired(runs, theirs[theirs["certified"]], "objective")
            allowed = both["gap_tol"].fillna(0.0) + both["gap_tol_rival"]
            within = both["objective"] - both["objective_rival"] <= allowed * (1 + 1e-9)
            both = both.assign(within=within.astype(float))
            if both.empty:
                finding.miss(f"runs that {against} certified")
            for place, part in groups(both, p):
                missed = part["limited"].astype(bool) & (part["within"] == 0)
                finding.add(
                    (name, against), place, intervals.share(of_trials(part, "within")[:, 0]),
                    p["claimed"], part, rises=bool(missed.any()),
                )  # fmt: skip
    return finding


@check("sensitivity", by=("test",))
def sensitivity(source: Source, p: Parameters) -> Finding:
    """Factor by which the cost changes between two priors, over the same factor of a rival.

    ``subject`` and ``rival`` are pairs of roles, with the one and with the other prior. A factor of 2 and
    one of 1/2 count the same. Time-outs hide how much a cost changes, so they decide nothing.
    """
    finding = Finding("factor between the costs under both n_p / the rival's factor")
    found = [next(source.runs(role, p, finding), None) for role in (*p["subject"], *p["rival"])]
    played = [each for each in found if each is not None]
    if len(played) < len(found):
        return finding
    names = played[0][0], played[2][0]
    for quantity in p["quantities"]:
        tables = [_comparable(runs.dropna(subset=quantity), quantity) for _, runs in played]
        common = functools.reduce(pd.Index.intersection, (table.index for table in tables))
        tables = [table.loc[common] for table in tables]
        for (test, _), _part in groups(tables[0], {"by": ["test"]}):
            parts = [
                table[table["test"].map(str).str.replace("_", " ") == test] for table in tables
            ]
            costs = {f"cost {at}": part[quantity] for at, part in enumerate(parts)}
            both = whole_trials(parts[0].assign(**costs), quantity)
            if both.empty:
                continue
            sums = of_trials(both, *costs, by="sum")
            factor, between = intervals.of_means(_factors, sums), None
            if quantity in TIMES:  # each of the two factors may be between days
                low = intervals.of_means(lambda means: _factors(means) / DAYS**2, sums)
                high = intervals.of_means(lambda means: _factors(means) * DAYS**2, sums)
                between = intervals.Extremes(low, high, UNEQUAL_DAYS)
            limited = any(part[CUT.get(quantity, "limited")].any() for part in parts)
            finding.add(
                names, (test, titled(quantity, unit=False)), factor, p["claimed"],
                *parts, rises=limited, falls=limited, extremes=between,
            )  # fmt: skip
    return finding


def _comparable(runs: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Return runs indexed by instance, and for times also by the number of parallel jobs."""
    jobs = runs["parallel_jobs"].fillna(0.0) if quantity in TIMES else 0.0
    return runs.assign(jobs=jobs).set_index(["instance_id", "jobs"])


def _factors(means: np.ndarray) -> np.ndarray:
    mine, other = (np.abs(np.log(means[:, a] / means[:, b])) for a, b in ((0, 1), (2, 3)))
    return np.exp(mine - other)
