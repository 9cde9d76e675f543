"""Compare two recorded versions: one verdict per experiment, method and metric.

- Work counters are integers that do not depend on the machine: one run that differs is a real change.
- A lost pose is always a regression. A lost certificate is one unless the run hit a time or memory limit.
- Success, certificates, RMSE, objective and integrals over boxes are paired over the same instances and
  judged by a sign test; a difference that may be due to chance is ``unclear``.
- Runs that hit the time or memory limit are excluded from counters, RMSE, objective and integrals,
  as they end at another point in each execution; they count in poses, success and the certified share.
- Between records of two machines, such runs are excluded from poses, success and certificates too.
- Runs of a method that is not installed on one side are excluded, and methods whose options, limits or
  prior differ in the two records.
- Times of records are measured once, on different days. They are compared only on the same machine and
  are never regressions. Times that were measured in turn (`tests.bench.interleaved`) can be.

Only the verdict ``worse`` is a regression.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from workflows import HISTORY, UserError
from workflows.integrals import KINDS
from workflows.metrics import METRICS
from workflows.outcomes import TIMED
from workflows.recording import Record, read
from workflows.timing import COUNTERS, judge, judge_once, judge_work

QUALITY = ("rmse", "objective")
SAME = 1e-6  # relative difference up to which two floating-point results are equal
SIGNIFICANT = 0.05
SETTINGS = ("options", "n_inliers_ratio", "limits")  # of a method, in a record


class CompareError(UserError):
    """Two sets of results cannot be compared; the message names file, value and remedy."""


@dataclass(frozen=True)
class Verdict:
    """The verdict on one metric of one method.

    `lost` and `won` are the instances that are worse and better in the head.
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
    if all(verdict.verdict == "not compared" for verdict in verdicts):
        raise CompareError(
            f"{base} and {head} share no instance and method with the same settings; record both with "
            "the same config"
        )
    if times is not None:
        verdicts += judge_times(times)
    return pd.DataFrame(map(asdict, verdicts))


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
    for work in judge_work(table):
        detail = f"{len(work.differing)} problems differ" if work.differing else ""
        yield Verdict(
            *where, work.counter, "count", "lower", work.base, work.head, work.verdict, detail
        )


def regressed(verdicts: pd.DataFrame) -> bool:
    """Whether any verdict is a regression."""
    return bool((verdicts["verdict"] == "worse").any())


def judge_records(name: str, base: Record, head: Record) -> Iterator[Verdict]:
    """Yield the verdicts on one experiment; methods with other settings are not compared."""
    for method in dict.fromkeys([*base.runs["method"], *head.runs["method"]]):
        old, new = (each.runs[each.runs["method"] == method] for each in (base, head))
        if other := _other_settings(base, head, method):
            sizes = float(len(old)), float(len(new))
            yield Verdict(name, method, "runs", "runs", "none", *sizes, "not compared", other)
        else:
            yield from judge_method(name, method, old, new)


def _other_settings(base: Record, head: Record, method: str) -> str:
    """Return which settings of a method differ between two records; empty if none does."""
    old, new = (each.about.get("methods", {}).get(method, {}) for each in (base, head))
    for name in (key for key in SETTINGS if key in old and key in new):
        one, other = old[name], new[name]
        if name == "limits":  # a later version may have more of them
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
        counted = steady[steady[[f"{counter}_base", f"{counter}_head"]].notna().all(axis=1)]
        if len(counted):
            yield counter, "count", noted(_counter(counted, counter))
    if steady.empty:
        return
    for metric in QUALITY:
        if steady[[*_sides(metric)]].isna().all().any():
            continue
        found = noted(_quality(steady, metric, METRICS[metric].worst))
        yield f"median {metric}", METRICS[metric].unit, found
    for kind in KINDS:
        known = steady[
            steady[[f"{kind}_integral_{s}" for s in _sides("boxes")]].notna().all(axis=1)
        ]
        if len(known):
            found = noted(_quality(known, f"{kind}_integral_boxes", np.nan))
            yield f"median {kind} integral", "boxes", found
    for metric in ("time_solve_s", *(f"{kind}_integral_s" for kind in KINDS)):
        if (steady[f"{metric}_base"] > 0).any():
            yield metric, "s, geometric mean", _times(steady, metric)


def _sides(name: str) -> tuple[str, str]:
    return f"{name}_base", f"{name}_head"


def _labels(pairs: pd.DataFrame) -> pd.Series:
    """Return what a reader needs to recognise the instances."""
    names = [f"{name}_base" for name in ("dataset", "shape", "test", "level", "trial")]
    labels = [" ".join(map(str, row)) for row in pairs[names].itertuples(index=False)]
    return pd.Series(labels, index=pairs.index, dtype=str)


def exact_p(wins: ArrayLike, losses: ArrayLike) -> np.ndarray:
    """Return p-values of the exact two-sided sign test; of right and wrong poses, McNemar's test."""
    from scipy.stats import binom

    return np.minimum(1.0, 2.0 * binom.cdf(np.minimum(wins, losses), np.add(wins, losses), 0.5))


def sign_test(better: int, worse: int) -> tuple[str, float]:
    """Return the verdict on paired differences, and its p-value: ``unclear`` if not significant."""
    if better == worse == 0:
        return "same", np.nan
    p_value = float(exact_p(better, worse))
    if p_value < SIGNIFICANT:
        return "worse" if worse > better else "better", p_value
    return "unclear", p_value


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
        found.verdict, found.detail = "worse", f"{len(found.lost)} poses lost ({why})"
    elif found.won:
        found.verdict, found.detail = "better", f"{len(found.won)} poses found"
    return found


def _wrong_bounds(pairs: pd.DataFrame) -> Judged:
    """Compare the numbers of lower bounds above the objective at the reference pose."""
    old, new = (pairs[f"bound_violation_{side}"].gt(0) for side in ("base", "head"))
    found = _paired(pairs, old.sum(), new.sum(), new & ~old, old & ~new)
    if found.lost or found.won:
        found.verdict = "worse" if found.lost else "better"
    return found


def _certified(pairs: pd.DataFrame) -> Judged:
    """Compare certificates; one that is lost without a time or memory limit is a regression."""
    old, new = (pairs[f"status_{side}"].eq("optimal") for side in ("base", "head"))
    lost = old & ~new
    found = _paired(pairs, old.sum(), new.sum(), lost, new & ~old)
    steady = int((lost & ~pairs["status_head"].isin(TIMED)).sum())
    if steady:
        found.verdict = "worse"
        found.detail += f"; {steady} lost without a time or memory limit"
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
    word = "worse" if change > 0 else "better" if change < 0 else "changed"
    why = f"{differing} of {len(pairs)} runs differ"
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
