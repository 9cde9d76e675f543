"""Compare two recorded versions: one verdict per experiment, method and metric.

- Work counters are integers that repeat exactly on one machine: one run that differs is a real change.
  Between records of two machines, rounding can change them, so a difference is ``changed``.
- A lost pose is always a regression. A lost certificate is one unless the run hit a time or memory limit,
  or another limit on another machine, whose rounding can cost a box. A lost success is one if the method
  is deterministic, both runs are of one machine, and neither hit a time or memory limit.
- Other losses of success and certificates, and RMSE, objective and integrals over boxes, are paired over
  the same instances and judged by a sign test, with Holm's correction over all tests that could find a
  difference; what may be due to chance is ``unclear``.
- Runs that hit the time or memory limit are excluded from counters, RMSE, objective and integrals,
  as they end at another point in each execution; they count in poses, success and the certified share.
- Between records of two machines, such runs are excluded from poses, success and certificates too.
- Runs of a method that is not installed on one side are excluded, and methods whose options, limits or
  prior differ in the two records. `Verdict.skipped` counts them. If only some runs of a method are
  unavailable in the head, that is a regression.
- Runs with another input are excluded too. If they are more than half of the runs of a method, that is a
  regression: the remaining runs are no evidence of the contrary.
- Runs, methods, experiments, counters, gaps and integrals that the head lacks are a regression.
- Times of records are measured once, on different days. They are compared only on the same machine and
  are never regressions. They are ``unclear`` if the time of another method differs whose declared version
  is the same in both records: the machine was then busier on one of the days. Times that were measured in
  turn (`tests.bench.interleaved`) can be regressions.

Only the verdict ``worse`` is a regression.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from workflows import HISTORY, UserError
from workflows.judges import Judged, joined, labels, of_fair_runs, of_steady_runs, wrong_bounds
from workflows.recording import Record, read
from workflows.significance import SIGNIFICANT, exact_p, holm
from workflows.timing import judge, judge_statuses, judge_work

TIMED_WORDS = ("slower", "faster")  # verdicts on times that were measured once
SETTINGS = ("options", "n_inliers_ratio", "limits")  # of a method, in a record


class CompareError(UserError):
    """Two sets of results cannot be compared; the message names file, value and remedy."""


@dataclass(frozen=True)
class Verdict:
    """The verdict on one metric of one method.

    `lost` and `won` are the instances that are worse and better in the head. `p_value` is NaN where a
    rule decided, not a sign test. `skipped` counts the runs of the base that are not compared.
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
    skipped: int = 0


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
    if all(
        each.metric == "runs" and (each.verdict != "worse" or each.skipped) for each in verdicts
    ):
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
            detail = joined(found[at].detail, why)
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


def judge_records(name: str, base: Record, head: Record) -> list[Verdict]:
    """Return the verdicts on one experiment; methods with other settings are not compared."""
    found = list(_judged_methods(name, base, head))
    timed = [verdict for verdict in found if verdict.verdict in TIMED_WORDS]
    same = [verdict for verdict in timed if _same_version(base, head, verdict.method)]

    def allowed_for(verdict: Verdict) -> Verdict:
        """Return the verdict, or ``unclear`` if the machine explains it."""
        own = _card(head, verdict.method).get("baseline")
        for other in same if verdict in timed else ():
            is_other = _card(head, other.method).get("baseline") != own
            if is_other and other.verdict == verdict.verdict:
                why = f"{other.method}, which did not change, is {other.verdict} too"
                return replace(verdict, verdict="unclear", detail=joined(verdict.detail, why))
        return verdict

    return [allowed_for(verdict) for verdict in found]


def _card(record: Record, method: str) -> dict[str, Any]:
    card: dict[str, Any] = record.about.get("methods", {}).get(method, {})
    return card


def _same_version(base: Record, head: Record, method: str) -> bool:
    """Whether both records declare the same version of a method."""
    old, new = (_card(each, method).get("version") for each in (base, head))
    return old is not None and old == new


def _judged_methods(name: str, base: Record, head: Record) -> Iterator[Verdict]:
    for method in dict.fromkeys([*base.runs["method"], *head.runs["method"]]):
        old, new = (each.runs[each.runs["method"] == method] for each in (base, head))
        if new.empty:
            yield _runs(name, method, len(old), 0, "worse", "the method is missing")
        elif other := _other_settings(base, head, method):
            found = _runs(name, method, len(old), len(new), "not compared", other)
            yield replace(found, skipped=len(old))
        else:
            yield from judge_method(name, method, old, new, _is_deterministic(base, head, method))


def _is_deterministic(base: Record, head: Record, method: str) -> bool:
    """Whether the same input always has the same result; so unless a record states otherwise."""
    cards = (_card(each, method) for each in (base, head))
    return all(card.get("deterministic") is not False for card in cards)


def _runs(experiment: str, method: str, old: int, new: int, verdict: str, detail: str) -> Verdict:
    """Return the verdict on runs that have no counterpart to compare with."""
    return Verdict(experiment, method, "runs", "runs", "none", old, new, verdict, detail)


def _other_settings(base: Record, head: Record, method: str) -> str:
    """Return which settings of a method differ between two records; empty if none does."""
    old, new = (_card(each, method) for each in (base, head))
    for name in (key for key in SETTINGS if key in old and key in new):
        one, other = old[name], new[name]
        if name == "limits" and one and other:  # a later version may have more of them
            shared = one.keys() & other.keys()
            one, other = ({key: each[key] for key in sorted(shared)} for each in (one, other))
        if one != other:
            return f"{name} differ: {one} and {other}"
    return ""


def judge_method(
    experiment: str, method: str, base: pd.DataFrame, head: pd.DataFrame, is_deterministic: bool
) -> Iterator[Verdict]:
    """Yield the verdicts on one method, over the runs that both versions have with the same input."""
    keys = ["instance_id", "instance_digest", "n_inliers"]
    pairs = base.merge(head, on=keys, suffixes=("_base", "_head"), validate="one_to_one")
    sizes = (len(base), len(head))
    if missing := len(set(base["instance_id"]) - set(head["instance_id"])):
        yield _runs(experiment, method, *sizes, "worse", f"{missing} runs are missing")
    if changed := len(base) - missing - len(pairs):
        word = "worse" if changed > len(pairs) else "not compared"
        found = _runs(experiment, method, *sizes, word, f"{changed} runs have another input")
        yield replace(found, skipped=changed)
    old, new = (pairs[f"status_{side}"].eq("unavailable") for side in ("base", "head"))
    for side, absent, skipped in (("base", old, 0), ("head", new & ~old, (new & ~old).sum())):
        if absent.any():
            why = f"{absent.sum()} runs are unavailable in the {side}"
            # a method that is not installed has no run at all
            word = "worse" if side == "head" and not (old | new).all() else "not compared"
            found = _runs(experiment, method, *sizes, word, why)
            yield replace(found, skipped=int(skipped))
    pairs = pairs[~(old | new)].assign(label=labels)
    unmatched = len(base) + len(head) - 2 * len(pairs)
    excluded = f"{unmatched} runs without a counterpart" if unmatched else ""

    def verdict(metric: str, unit: str, better: str, found: Judged) -> Verdict:
        return Verdict(
            experiment, method, metric, unit, better, float(found.base), float(found.head),
            found.verdict, joined(found.detail, excluded), found.p_value, list(found.lost),
            list(found.won),
        )  # fmt: skip

    if pairs.empty:
        return
    yield verdict("wrong bounds", "runs", "lower", wrong_bounds(pairs))
    for metric, better, judged in of_fair_runs(pairs, is_deterministic):
        yield verdict(metric, "runs", better, judged)
    for metric, unit, judged in of_steady_runs(pairs):
        yield verdict(metric, unit, "lower", judged)
