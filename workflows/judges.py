"""Judge the metrics of paired runs: those of two versions on the same instance.

`workflows.compare` states the rules.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd

from workflows.metrics import METRICS
from workflows.outcomes import TIMED, outcome
from workflows.significance import sign_test
from workflows.timing import COUNTERS, judge_once, word_of_work

QUALITY = ("rmse", "objective")
JUDGED = "gap"  # integral; the others depend on the best objective of all methods of a record
SAME = 1e-6  # relative difference up to which two floating-point results are equal


@dataclass
class Judged:
    """Values, verdict and evidence of one metric."""

    base: float
    head: float
    verdict: str
    detail: str = ""
    p_value: float = np.nan
    lost: Sequence[str] = ()
    won: Sequence[str] = ()

    def decide(self, verdict: str, detail: str) -> None:
        """Decide by a rule, whatever the sign test says."""
        self.verdict, self.detail, self.p_value = verdict, detail, np.nan


def of_fair_runs(pairs: pd.DataFrame, is_deterministic: bool) -> Iterator[tuple[str, str, Judged]]:
    """Yield metric, direction and verdict of what a time limit decides fairly on one machine only."""
    unfair = _timed(pairs) & (pairs["machine_id_base"] != pairs["machine_id_head"])
    note = f"{unfair.sum()} runs at a limit excluded, from two machines" if unfair.any() else ""
    fair = pairs[~unfair]
    success = partial(_success, is_deterministic=is_deterministic)
    judges: dict[str, tuple[str, Callable[[pd.DataFrame], Judged]]] = {
        "without pose": ("lower", _poses),
        "success": ("higher", success),
    }
    if fair[["gap_base", "gap_head"]].notna().any(axis=None):
        judges |= {"certified": ("higher", _certified), "with gap": ("higher", _gaps)}
    for metric, (better, judged) in judges.items():
        found = Judged(np.nan, np.nan, "not compared") if fair.empty else judged(fair)
        found.detail = joined(found.detail, note)
        yield metric, better, found


def _timed(pairs: pd.DataFrame) -> pd.Series:
    """Tell which runs hit the time or memory limit on at least one side."""
    return pairs[["status_base", "status_head"]].isin(TIMED).any(axis=1)


def of_steady_runs(pairs: pd.DataFrame) -> Iterator[tuple[str, str, Judged]]:
    """Yield metric, unit and verdict of all comparisons of runs without a time or memory limit."""
    timed = _timed(pairs)
    steady = pairs[~timed]
    note = f"{timed.sum()} runs at a time or memory limit excluded" if timed.any() else ""

    def noted(found: Judged) -> Judged:
        found.detail = joined(found.detail, note)
        return found

    for counter in COUNTERS:
        if found := _of_stated(steady, counter, partial(_counter, name=counter)):
            yield counter, "count", noted(found)
    if steady.empty:
        return
    for metric in QUALITY:
        if steady[[*_sides(metric)]].isna().all().any():
            continue
        found = noted(_quality(steady, metric, METRICS[metric].worst))
        yield f"median {metric}", METRICS[metric].unit, found
    name = f"{JUDGED}_integral_boxes"
    if found := _of_stated(steady, name, partial(_quality, name=name, worst=np.nan)):
        yield f"median {JUDGED} integral", "boxes", noted(found)
    for metric in ("time_solve_s", f"{JUDGED}_integral_s"):
        if (steady[f"{metric}_base"] > 0).any():
            yield metric, "s, geometric mean", _times(steady, metric)


def _of_stated(
    pairs: pd.DataFrame, column: str, judged: Callable[[pd.DataFrame], Judged]
) -> Judged | None:
    """Judge the pairs that state a number on both sides; None if the base states none.

    A run that returns a result and no longer states the number is a regression.
    """
    old, new = (pairs[side].notna() for side in _sides(column))
    if not (old & new).any():
        return Judged(np.nan, np.nan, "worse", "no longer stated") if old.any() else None
    found = judged(pairs[old & new])
    if (gone := old & ~new & _answered(pairs)).any():
        found.decide("worse", joined(found.detail, f"{gone.sum()} runs no longer state it"))
        found.lost = [*found.lost, *pairs["label"][gone]]
    return found


def _answered(pairs: pd.DataFrame) -> pd.Series:
    """Tell which runs of the head ended with a result: they finished or hit a limit."""
    return pairs["status_head"].map(outcome).isin(("finished", "limited"))


def _sides(name: str) -> tuple[str, str]:
    return f"{name}_base", f"{name}_head"


def labels(pairs: pd.DataFrame) -> pd.Series:
    """Return what a reader needs to recognise the instances."""
    names = [f"{name}_base" for name in ("dataset", "shape", "test", "level", "trial")]
    labels = [" ".join(map(str, row)) for row in pairs[names].itertuples(index=False)]
    return pd.Series(labels, index=pairs.index, dtype=str)


def _paired(pairs: pd.DataFrame, old: float, new: float, lost: pd.Series, won: pd.Series) -> Judged:
    """Judge a paired metric by a sign test; `lost` and `won` mark the instances that differ."""
    word, p_value = sign_test(int(won.sum()), int(lost.sum()))
    detail = ""
    if word != "same":
        detail = f"{lost.sum()} lost, {won.sum()} won of {len(pairs)}; sign test p = {p_value:.2g}"
    return Judged(old, new, word, detail, p_value, [*pairs["label"][lost]], [*pairs["label"][won]])


def _poses(pairs: pd.DataFrame) -> Judged:
    old, new = (pairs[f"rmse_{side}"].isna() for side in ("base", "head"))
    found = _paired(pairs, old.sum(), new.sum(), new & ~old, old & ~new)
    if found.lost:
        ended = pairs.loc[new & ~old, "status_head"].value_counts().items()
        why = ", ".join(f"{count} {status}" for status, count in ended)
        found.decide("worse", f"{len(found.lost)} poses lost ({why})")
    elif found.won:
        found.decide("better", f"{len(found.won)} poses found")
    return found


def wrong_bounds(pairs: pd.DataFrame) -> Judged:
    """Compare the numbers of lower bounds above the objective at the reference pose."""
    old, new = (pairs[f"bound_violation_{side}"].gt(0) for side in ("base", "head"))
    found = _paired(pairs, old.sum(), new.sum(), new & ~old, old & ~new)
    if found.lost or found.won:
        found.decide("worse" if found.lost else "better", found.detail)
    return found


def _certified(pairs: pd.DataFrame) -> Judged:
    """Compare certificates; one that is lost without a time or memory limit is a regression."""
    old, new = (pairs[f"status_{side}"].eq("optimal") for side in ("base", "head"))
    lost = old & ~new
    found = _paired(pairs, old.sum(), new.sum(), lost, new & ~old)
    elsewhere = pairs["machine_id_base"] != pairs["machine_id_head"]  # rounding can cost a box
    excused = pairs["status_head"].isin(TIMED)
    excused |= elsewhere & pairs["status_head"].isin(("node_limit", "assignment_limit"))
    steady = int((lost & ~excused).sum())
    if steady:
        found.decide("worse", f"{found.detail}; {steady} lost without a limit that explains it")
    return found


def _gaps(pairs: pd.DataFrame) -> Judged:
    """Compare the numbers of runs that state a gap."""
    old, new = (pairs[side].notna() for side in _sides("gap"))
    found = _paired(pairs, old.sum(), new.sum(), old & ~new & _answered(pairs), new & ~old)
    if found.lost:
        found.decide("worse", f"{len(found.lost)} runs no longer state a gap")
    elif found.won:
        found.decide("better", f"{len(found.won)} more runs state a gap")
    return found


def _success(pairs: pd.DataFrame, is_deterministic: bool) -> Judged:
    """Compare successes; one that chance, time, memory or the machine cannot explain is a regression."""
    old, new = pairs["success_base"].astype(bool), pairs["success_head"].astype(bool)
    found = _paired(pairs, old.sum(), new.sum(), old & ~new, new & ~old)
    elsewhere = pairs["machine_id_base"] != pairs["machine_id_head"]
    steady = int((old & ~new & ~_timed(pairs) & ~elsewhere).sum())
    if steady and is_deterministic:
        found.decide("worse", f"{found.detail}; {steady} lost without a limit that explains it")
    return found


def _counter(pairs: pd.DataFrame, name: str) -> Judged:
    old, new = pairs[f"{name}_base"], pairs[f"{name}_head"]
    differing = int((old != new).sum())
    if not differing:
        return Judged(old.sum(), new.sum(), "same")
    more, fewer = int((new > old).sum()), int((new < old).sum())
    word = word_of_work(old, new)
    why = f"{differing} of {len(pairs)} runs differ: {more} with more work, {fewer} with less"
    if (pairs["machine_id_base"] != pairs["machine_id_head"]).any():
        word, why = "changed", f"{why}; from two machines, whose rounding can differ"
    lost, won = [*pairs["label"][new > old]], [*pairs["label"][new < old]]
    return Judged(old.sum(), new.sum(), word, why, np.nan, lost, won)


def _quality(pairs: pd.DataFrame, name: str, worst: float) -> Judged:
    old, new = (pairs[side].fillna(worst).astype(float) for side in _sides(name))
    differs = pd.Series(~np.isclose(old, new, rtol=SAME, atol=1e-12), index=pairs.index)
    return _paired(pairs, old.median(), new.median(), differs & (new > old), differs & (new < old))


def _times(pairs: pd.DataFrame, name: str) -> Judged:
    timed = pairs[pairs[[*_sides(name)]].gt(0).all(axis=1)]
    timed = timed[timed["machine_id_base"] == timed["machine_id_head"]]
    if timed.empty:
        return Judged(np.nan, np.nan, "not compared", "no time of both versions on one machine")
    old, new = (timed[side].to_numpy(dtype=float) for side in _sides(name))
    before, after = (float(np.exp(np.log(side).mean())) for side in (old, new))
    word, ratio = judge_once(old, new)
    return Judged(before, after, word, f"{ratio}; measured once, never a regression")


def joined(*parts: str) -> str:
    return "; ".join(part for part in parts if part)
