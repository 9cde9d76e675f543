"""Compare two recorded versions: one verdict per experiment, method and metric.

- Work counters are integers that repeat exactly on one machine: one run that differs is a real change.
  Between records of two machines, rounding can change them, so a difference is ``changed``.
- A lost pose is always a regression. A lost certificate is one unless the run hit a time or memory limit,
  or another limit on another machine, whose rounding can cost a box.
- Success, certificates, RMSE, objective and integrals over boxes are paired over the same instances and
  judged by a sign test, with Holm's correction over all tests that could find a difference; what may be
  due to chance is ``unclear``.
- Runs that hit the time or memory limit are excluded from counters, RMSE, objective and integrals,
  as they end at another point in each execution; they count in poses, success and the certified share.
- Between records of two machines, such runs are excluded from poses, success and certificates too.
- Runs of a method that is not installed on one side are excluded, and methods whose options, limits or
  prior differ in the two records.
- Runs, methods, experiments, counters and integrals that the head lacks are a regression.
- Times of records are measured once, on different days. They are compared only on the same machine and
  are never regressions. Times that were measured in turn (`tests.bench.interleaved`) can be.

Only the verdict ``worse`` is a regression.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from workflows import HISTORY, UserError
from workflows.integrals import KINDS
from workflows.metrics import METRICS
from workflows.outcomes import TIMED
from workflows.recording import Record, read
from workflows.significance import SIGNIFICANT, exact_p, holm, sign_test
from workflows.timing import COUNTERS, judge, judge_once, judge_statuses, judge_work

QUALITY = ("rmse", "objective")
SAME = 1e-6  # relative difference up to which two floating-point results are equal
SETTINGS = ("options", "n_inliers_ratio", "limits")  # of a method, in a record


class CompareError(UserError):
    """Two sets of results cannot be compared; the message names file, value and remedy."""


@dataclass(frozen=True)
class Verdict:
    """The verdict on one metric of one method.

    `lost` and `won` are the instances that are worse and better in the head. `p_value` is NaN where a
    rule decided, not a sign test.
    """

    experiment: str
    method: str
    metric: str
    unit: str
    better: str
    base: float
    head: float
    verdict: str  # same, better, worse, changed, slower, faster, unclear, not compared
    detail: str
    p_value: float = np.nan
    lost: list[str] = field(default_factory=list)
    won: list[str] = field(default_factory=list)


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


def compare(
    base: str, head: str, history: Path = HISTORY, times: Path | None = None
) -> pd.DataFrame:
    """Return the verdicts on all experiments that both versions have.

    Parameters
    ----------
    base, head : str
        Recorded versions, folders of records, or folders of results.
    history : Path
    times : Path, optional
        Table of `tests.bench.interleaved`: CPU times of both versions, measured in turn.

    Raises
    ------
    CompareError, RecordError, SchemaError
    """
    old, new = read(base, history), read(head, history)
    shared = [name for name in old if name in new]
    if not shared:
        raise CompareError(
            f"{base} has {', '.join(old)} and {head} has {', '.join(new)}: no experiment in common; "
            "record the same experiment for both"
        )
    verdicts = [verdict for name in shared for verdict in judge_records(name, old[name], new[name])]
    if all(verdict.metric == "runs" and verdict.verdict != "worse" for verdict in verdicts):
        raise CompareError(
            f"{base} and {head} share no instance and method with the same settings; record both with "
            "the same config"
        )
    verdicts = corrected(verdicts)
    for name in (name for name in old if name not in new):
        verdicts.append(_runs(name, "all", len(old[name].runs), 0, "worse", f"not in {head}"))
    if times is not None:
        verdicts += judge_times(times)
    return pd.DataFrame(map(asdict, verdicts))


def corrected(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Return the verdicts after Holm's correction over all sign tests that could find a difference."""
    tested = [at for at, verdict in enumerate(verdicts) if _can_be_significant(verdict)]
    found = list(verdicts)
    for at, level in zip(tested, holm([found[at].p_value for at in tested]), strict=True):
        if level < found[at].p_value < SIGNIFICANT:
            why = f"p of at most {level:.2g} needed, as one of {len(tested)} tests"
            detail = _joined(found[at].detail, why)
            found[at] = replace(found[at], verdict="unclear", detail=detail)
    return found


def _can_be_significant(verdict: Verdict) -> bool:
    """Whether a sign test decided that could find anything in so few runs; others cost it nothing."""
    differing = len(verdict.lost) + len(verdict.won)
    return not np.isnan(verdict.p_value) and bool(exact_p(0, differing) < SIGNIFICANT)


def judge_times(path: Path) -> Iterator[Verdict]:
    """Yield the verdicts on CPU times and work that were measured in turn.

    Raises
    ------
    CompareError
    """
    if not path.is_file():
        raise CompareError(f"{path}: no such table; measure it with `make timings OLD=folder`")
    table = pd.read_csv(path)
    where = ("timings", "dcreg")
    for timed in judge(table):
        word = {"slower": "worse", "faster": "better"}.get(timed.verdict, timed.verdict)
        yield Verdict(
            *where, f"CPU time, {timed.group}", "s, mean", "lower", timed.base_s, timed.head_s, word,
            timed.summary,
        )  # fmt: skip
    for work in (*judge_work(table), judge_statuses(table)):
        better = "higher" if work.counter == "optimal" else "lower"
        yield Verdict(
            *where, work.counter, "count", better, work.base, work.head, work.verdict, work.detail
        )


def regressed(verdicts: pd.DataFrame) -> bool:
    """Whether any verdict is a regression."""
    return bool((verdicts["verdict"] == "worse").any())


def judge_records(name: str, base: Record, head: Record) -> Iterator[Verdict]:
    """Yield the verdicts on one experiment; methods with other settings are not compared."""
    for method in dict.fromkeys([*base.runs["method"], *head.runs["method"]]):
        old, new = (each.runs[each.runs["method"] == method] for each in (base, head))
        if new.empty:
            yield _runs(name, method, len(old), 0, "worse", "the method is missing")
        elif other := _other_settings(base, head, method):
            yield _runs(name, method, len(old), len(new), "not compared", other)
        else:
            yield from judge_method(name, method, old, new)


def _runs(experiment: str, method: str, old: int, new: int, verdict: str, detail: str) -> Verdict:
    """Return the verdict on runs that have no counterpart to compare with."""
    return Verdict(experiment, method, "runs", "runs", "none", old, new, verdict, detail)


def _other_settings(base: Record, head: Record, method: str) -> str:
    """Return which settings of a method differ between two records; empty if none does."""
    old, new = (each.about.get("methods", {}).get(method, {}) for each in (base, head))
    for name in (key for key in SETTINGS if key in old and key in new):
        one, other = old[name], new[name]
        if name == "limits" and one and other:  # a later version may have more of them
            shared = one.keys() & other.keys()
            one, other = ({key: each[key] for key in sorted(shared)} for each in (one, other))
        if one != other:
            return f"{name} differ: {one} and {other}"
    return ""


def judge_method(
    experiment: str, method: str, base: pd.DataFrame, head: pd.DataFrame
) -> Iterator[Verdict]:
    """Yield the verdicts on one method, over the runs that both versions have with the same input."""
    keys = ["instance_id", "instance_digest", "n_inliers"]
    pairs = base.merge(head, on=keys, suffixes=("_base", "_head"), validate="one_to_one")
    n_same = len(pairs)
    absent = pairs[["status_base", "status_head"]].isin(["unavailable"]).any(axis=1)
    pairs = pairs[~absent].assign(label=_labels)
    unmatched = len(base) + len(head) - 2 * len(pairs)
    excluded = f"{unmatched} runs without a counterpart" if unmatched else ""

    def verdict(metric: str, unit: str, better: str, found: Judged) -> Verdict:
        return Verdict(
            experiment, method, metric, unit, better, float(found.base), float(found.head),
            found.verdict, _joined(found.detail, excluded), found.p_value, list(found.lost),
            list(found.won),
        )  # fmt: skip

    sizes, ids = (len(base), len(head)), set(head["instance_id"])
    if missing := len(set(base["instance_id"]) - ids):
        yield _runs(experiment, method, *sizes, "worse", f"{missing} runs are missing")
    if changed := len(base) - missing - n_same:
        yield _runs(
            experiment, method, *sizes, "not compared", f"{changed} runs have another input"
        )
    if pairs.empty:
        yield verdict("runs", "runs", "none", Judged(len(base), len(head), "not compared"))
        return
    yield verdict("wrong bounds", "runs", "lower", _wrong_bounds(pairs))
    for metric, better, found in _of_fair_runs(pairs):
        yield verdict(metric, "runs", better, found)
    for metric, unit, found in _of_steady_runs(pairs):
        yield verdict(metric, unit, "lower", found)


def _of_fair_runs(pairs: pd.DataFrame) -> Iterator[tuple[str, str, Judged]]:
    """Yield metric, direction and verdict of what a time limit decides fairly on one machine only."""
    unfair = _timed(pairs) & (pairs["machine_id_base"] != pairs["machine_id_head"])
    note = f"{unfair.sum()} runs at a limit excluded, from two machines" if unfair.any() else ""
    fair = pairs[~unfair]
    judges = {"without pose": ("lower", _poses), "success": ("higher", _success)}
    if fair[["gap_base", "gap_head"]].notna().any(axis=None):
        judges["certified"] = ("higher", _certified)
    for metric, (better, judged) in judges.items():
        found = Judged(np.nan, np.nan, "not compared") if fair.empty else judged(fair)
        found.detail = _joined(found.detail, note)
        yield metric, better, found


def _timed(pairs: pd.DataFrame) -> pd.Series:
    """Tell which runs hit the time or memory limit on at least one side."""
    return pairs[["status_base", "status_head"]].isin(TIMED).any(axis=1)


def _of_steady_runs(pairs: pd.DataFrame) -> Iterator[tuple[str, str, Judged]]:
    """Yield metric, unit and verdict of all comparisons of runs without a time or memory limit."""
    timed = _timed(pairs)
    steady = pairs[~timed]
    note = f"{timed.sum()} runs at a time or memory limit excluded" if timed.any() else ""

    def noted(found: Judged) -> Judged:
        found.detail = _joined(found.detail, note)
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
    for kind in KINDS:
        name = f"{kind}_integral_boxes"
        if found := _of_stated(steady, name, partial(_quality, name=name, worst=np.nan)):
            yield f"median {kind} integral", "boxes", noted(found)
    for metric in ("time_solve_s", *(f"{kind}_integral_s" for kind in KINDS)):
        if (steady[f"{metric}_base"] > 0).any():
            yield metric, "s, geometric mean", _times(steady, metric)


def _of_stated(
    pairs: pd.DataFrame, column: str, judged: Callable[[pd.DataFrame], Judged]
) -> Judged | None:
    """Judge the pairs that state a number on both sides; None if the base states none."""
    old, new = (pairs[side].notna() for side in _sides(column))
    if (old & new).any():
        return judged(pairs[old & new])
    return Judged(np.nan, np.nan, "worse", "no longer stated") if old.any() else None


def _sides(name: str) -> tuple[str, str]:
    return f"{name}_base", f"{name}_head"


def _labels(pairs: pd.DataFrame) -> pd.Series:
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


def _wrong_bounds(pairs: pd.DataFrame) -> Judged:
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


def _success(pairs: pd.DataFrame) -> Judged:
    old, new = pairs["success_base"].astype(bool), pairs["success_head"].astype(bool)
    return _paired(pairs, old.sum(), new.sum(), old & ~new, new & ~old)


def _counter(pairs: pd.DataFrame, name: str) -> Judged:
    old, new = pairs[f"{name}_base"], pairs[f"{name}_head"]
    differing = int((old != new).sum())
    if not differing:
        return Judged(old.sum(), new.sum(), "same")
    change = new.sum() - old.sum()
    more, fewer = int((new > old).sum()), int((new < old).sum())
    word = "changed" if change == 0 and more == fewer else "better"
    if change > 0 or more > fewer:
        word = "worse"
    why = f"{differing} of {len(pairs)} runs differ"
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


def _joined(*parts: str) -> str:
    return "; ".join(part for part in parts if part)
