"""Keeps small tables of a version, and judges a later version against them.

Verdicts, per experiment, method and metric:

- Work counters are integers that no machine changes: a single differing run is a real change.
- A pose that is lost is a regression, whatever took it.
- Quality (RMSE, objective, success) is paired over the same instances and judged by a sign test;
  a difference the test cannot tell from chance is shown as ``unclear``, not hidden.
- Runs that the clock ended are left out of counters, RMSE and objective, as they differ from one
  execution to the next; they count in poses, success and the certified share.
- Runs of a method that is not installed on one side are left out.
- Times are compared within one machine only, and never fail a comparison.

``worse`` is a regression; every other verdict is not.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from dcreg.files import whole_file
from workflows import UserError, provenance, records
from workflows.metrics import METRICS

RECORDED = [
    "run_id",
    "method",
    "instance_id",
    "instance_digest",
    "dataset",
    "shape",
    "test",
    "level",
    "trial",
    "model",
    "n_inliers",
    "status",
    "message",
    "n_nodes",
    "n_assignments",
    "lower_bound",
    "upper_bound",
    "gap",
    "objective",
    "objective_true",
    "rmse",
    "success",
    "bound_violation",
    "time_solve_s",
    "machine_id",
    "fingerprint",
]
COUNTERS = ("n_nodes", "n_assignments")
QUALITY = ("rmse", "objective")
CLOCKED = ("time_limit", "memory_limit")  # statuses that another execution may not repeat
EXPERIMENTS = ("demo", "real2d")  # kept by default
SAME = 1e-6  # relative difference below which two floating results are one
SIGNIFICANT = 0.05
NOTICEABLE = 1.2  # ratio of times


class CompareError(UserError):
    """Two versions cannot be compared; the message names file, value and remedy."""


@dataclass(frozen=True)
class Verdict:
    experiment: str
    method: str
    metric: str
    unit: str
    better: str
    base: float
    head: float
    verdict: str  # same, better, worse, changed, unclear, not compared
    detail: str


# --- keeping -----------------------------------------------------------------------------------


def results_to_record(results: Path = Path("results")) -> list[Path]:
    """Results of the experiments that are kept by default."""
    folders = [results / name for name in EXPERIMENTS if (results / name / "tables").is_dir()]
    if not folders:
        raise CompareError(f"{results}: no results of {' or '.join(EXPERIMENTS)}; run one first")
    return folders


def record(folder: Path, history: Path, version: str = "") -> Path:
    """Keep the small table of an experiment; returns the folder it is in."""
    runs = records.read(folder / "tables" / "runs.parquet", records.runs_columns())
    known = json.loads((folder / "tables" / "provenance.json").read_text(encoding="utf-8"))
    if known["selection"]:
        raise CompareError(
            f"{folder}: holds a selection of the experiment ({known['selection']}); "
            "run all of it before recording"
        )
    version = version or provenance.default_version()
    out = history / version / known["experiment"]
    out.mkdir(parents=True, exist_ok=True)
    with whole_file(out / "runs.csv") as part:
        runs[RECORDED].to_csv(part, index=False)
    about = {key: known[key] for key in ("schema_version", "experiment", "machine", "versions")}
    about |= {"version": version, "git": known["git"], "created": known["created"]}
    with whole_file(out / "about.json") as part:
        part.write_text(json.dumps(about, indent=1), encoding="utf-8")
    return out


def read_version(name: str, history: Path) -> dict[str, pd.DataFrame]:
    """Tables of a recorded version (or of a folder), by experiment."""
    folder = history / name
    if not folder.is_dir():
        folder = Path(name)
    paths = sorted(folder.glob("*/runs.csv"))
    if not paths:
        kept = sorted(path.name for path in history.glob("*") if path.is_dir())
        raise CompareError(
            f"no records of {name!r} in {history}; known: {', '.join(kept) or 'none'}. "
            f"Make them with `python -m workflows record --version {name}`"
        )
    return {path.parent.name: _read(path) for path in paths}


def _read(path: Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(path, dtype={"instance_digest": str, "instance_id": str})
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise CompareError(f"{path}: not a readable table ({error}); record it again") from error
    missing = [column for column in RECORDED if column not in table]
    if missing:
        raise CompareError(f"{path}: column {missing[0]!r} is missing; record it again")
    return table


# --- judging -----------------------------------------------------------------------------------


def compare(base: str, head: str, history: Path) -> pd.DataFrame:
    """Verdicts on all experiments that both versions have."""
    old, new = read_version(base, history), read_version(head, history)
    shared = [name for name in old if name in new]
    if not shared:
        raise CompareError(
            f"{base} has {', '.join(old)} and {head} has {', '.join(new)}: nothing in common"
        )
    verdicts = [
        verdict for name in shared for verdict in judge_experiment(name, old[name], new[name])
    ]
    if all(verdict.verdict == "not compared" for verdict in verdicts):
        raise CompareError(f"{base} and {head} share no instance; record both with one config")
    return pd.DataFrame(map(asdict, verdicts))


def regressed(verdicts: pd.DataFrame) -> bool:
    return bool((verdicts["verdict"] == "worse").any())


def judge_experiment(name: str, base: pd.DataFrame, head: pd.DataFrame) -> Iterator[Verdict]:
    """Verdicts on every method of one experiment."""
    for method in dict.fromkeys([*base["method"], *head["method"]]):
        yield from judge_method(
            name, method, base[base["method"] == method], head[head["method"] == method]
        )


def judge_method(
    experiment: str, method: str, base: pd.DataFrame, head: pd.DataFrame
) -> Iterator[Verdict]:
    """Verdicts on one method, over the runs that both versions made of the same content."""
    keys = ["instance_id", "instance_digest", "n_inliers"]
    pairs = base.merge(head, on=keys, suffixes=("_base", "_head"), validate="one_to_one")
    absent = pairs[["status_base", "status_head"]].isin(["unavailable"]).any(axis=1)
    pairs = pairs[~absent]
    alone = len(base) + len(head) - 2 * len(pairs)
    left_out = f"{alone} runs without counterpart" if alone else ""

    def verdict(
        metric: str, unit: str, better: str, old: float, new: float, word: str, why: str
    ) -> Verdict:
        detail = "; ".join(part for part in (why, left_out) if part)
        return Verdict(
            experiment, method, metric, unit, better, float(old), float(new), word, detail
        )

    if pairs.empty:
        yield verdict("runs", "runs", "none", len(base), len(head), "not compared", "")
        return
    yield verdict("without pose", "runs", "lower", *_poses(pairs))
    yield verdict("wrong bounds", "runs", "lower", *_wrong_bounds(pairs))
    if pairs[["gap_base", "gap_head"]].notna().any(axis=None):
        yield verdict("certified", "runs", "higher", *_certified(pairs))
    yield verdict("success", "runs", "higher", *_success(pairs))

    clocked = pairs[["status_base", "status_head"]].isin(CLOCKED).any(axis=1)
    steady = pairs[~clocked]
    note = f"{clocked.sum()} runs ended by the clock left out" if clocked.any() else ""
    for counter in COUNTERS:
        counted = steady[steady[[f"{counter}_base", f"{counter}_head"]].notna().all(axis=1)]
        if len(counted):
            old, new, word, why = _counter(counted, counter)
            yield verdict(counter, "count", "lower", old, new, word, _joined(why, note))
    if steady.empty:
        return
    for metric in QUALITY:
        old, new, word, why = _quality(steady, metric)
        unit = METRICS[metric].unit
        yield verdict(f"median {metric}", unit, "lower", old, new, word, _joined(why, note))
    yield verdict("time_solve_s", "s, geometric mean", "lower", *_times(steady))


def sign_test(better: int, worse: int) -> str:
    """``same`` without a difference, a side where chance would rarely tip so far, else unclear."""
    from scipy.stats import binomtest

    if better == worse == 0:
        return "same"
    if binomtest(worse, better + worse).pvalue < SIGNIFICANT:
        return "worse" if worse > better else "better"
    return "unclear"


Judged = tuple[float, float, str, str]  # value in base, value in head, verdict, detail


def _poses(pairs: pd.DataFrame) -> Judged:
    old, new = (pairs[f"rmse_{side}"].isna() for side in ("base", "head"))
    lost, found = pairs[new & ~old], int((old & ~new).sum())
    if lost.empty and not found:
        return old.sum(), new.sum(), "same", ""
    ended = ", ".join(
        f"{count} {status}" for status, count in lost["status_head"].value_counts().items()
    )
    why = f"{len(lost)} poses lost{f' ({ended})' if ended else ''}, {found} found"
    return old.sum(), new.sum(), "worse" if len(lost) else "better", why


def _wrong_bounds(pairs: pd.DataFrame) -> Judged:
    """Lower bounds above a value that the truth attains: one is one too many."""
    old, new = (int(pairs[f"bound_violation_{side}"].gt(0).sum()) for side in ("base", "head"))
    word = "worse" if new > old else "better" if new < old else "same"
    return old, new, word, ""


def _certified(pairs: pd.DataFrame) -> Judged:
    """A certificate lost to anything but the clock is a change; lost to the clock, maybe not."""
    old, new = (pairs[f"status_{side}"].eq("optimal") for side in ("base", "head"))
    lost, gained = pairs[old & ~new], int((new & ~old).sum())
    one_machine = lost["machine_id_base"] == lost["machine_id_head"]
    much_slower = one_machine & (lost["time_solve_s_base"] < lost["time_solve_s_head"] / 2)
    really = int((much_slower | (lost["status_head"] != "time_limit")).sum())
    if really:
        word = "worse"
    elif len(lost):
        word = "unclear"
    else:
        word = "better" if gained else "same"
    return (
        old.sum(),
        new.sum(),
        word,
        f"{len(lost)} lost, {gained} gained" if word != "same" else "",
    )


def _counter(pairs: pd.DataFrame, name: str) -> Judged:
    old, new = pairs[f"{name}_base"], pairs[f"{name}_head"]
    differing = int((old != new).sum())
    if not differing:
        return old.sum(), new.sum(), "same", ""
    change = new.sum() - old.sum()
    word = "worse" if change > 0 else "better" if change < 0 else "changed"
    return old.sum(), new.sum(), word, f"{differing} of {len(pairs)} runs differ"


def _success(pairs: pd.DataFrame) -> Judged:
    old, new = pairs["success_base"].astype(bool), pairs["success_head"].astype(bool)
    lost, gained = int((old & ~new).sum()), int((new & ~old).sum())
    why = f"{lost} lost, {gained} gained" if lost or gained else ""
    return old.sum(), new.sum(), sign_test(gained, lost), why


def _quality(pairs: pd.DataFrame, name: str) -> Judged:
    worst = METRICS[name].worst
    old = pairs[f"{name}_base"].fillna(worst).to_numpy(dtype=float)
    new = pairs[f"{name}_head"].fillna(worst).to_numpy(dtype=float)
    same = np.isclose(old, new, rtol=SAME, atol=1e-12)
    better, worse = int((~same & (new < old)).sum()), int((~same & (new > old)).sum())
    why = f"{better} better, {worse} worse of {len(pairs)}" if better or worse else ""
    return np.median(old), np.median(new), sign_test(better, worse), why


def _times(pairs: pd.DataFrame) -> Judged:
    timed = pairs[pairs[["time_solve_s_base", "time_solve_s_head"]].gt(0).all(axis=1)]
    timed = timed[timed["machine_id_base"] == timed["machine_id_head"]]
    if timed.empty:
        return np.nan, np.nan, "not compared", "no run of both on one machine"
    old, new = np.log(timed["time_solve_s_base"]), np.log(timed["time_solve_s_head"])
    means = float(np.exp(old.mean())), float(np.exp(new.mean()))
    ratio = means[1] / means[0]
    tested = sign_test(int((new < old).sum()), int((new > old).sum()))
    if max(ratio, 1 / ratio) < NOTICEABLE:
        word = "same"
    elif tested in ("better", "worse"):
        word = "slower" if ratio > 1 else "faster"
    else:
        word = "unclear"
    return *means, word, f"ratio {ratio:.2f}; never a failure"


def _joined(*parts: str) -> str:
    return "; ".join(part for part in parts if part)


# --- printing ----------------------------------------------------------------------------------

STYLES = {"worse": "bold red", "better": "green", "changed": "yellow", "unclear": "yellow"}


def print_verdicts(verdicts: pd.DataFrame, base: str, head: str) -> None:
    """Everything that is not the same, then one line on the whole."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if os.isatty(1) else 140)
    for experiment, group in verdicts.groupby("experiment", sort=False):
        table = Table(title=f"{experiment}: {base} → {head}", title_justify="left")
        for column in ("method", "metric", "unit", "better is", base, head, "verdict", "detail"):
            table.add_column(column, justify="right" if column in (base, head) else "left")
        for values in group[group["verdict"] != "same"].itertuples(index=False):
            row = Verdict(*values)
            style = STYLES.get(row.verdict, "")
            table.add_row(
                *(row.method, row.metric, row.unit, row.better),
                *(f"{row.base:.6g}", f"{row.head:.6g}"),
                f"[{style}]{row.verdict}[/]" if style else row.verdict,
                row.detail,
            )
        same = int((group["verdict"] == "same").sum())
        if table.row_count:
            console.print(table)
        console.print(f"{experiment}: {same} of {len(group)} metrics are the same")
    worse = int((verdicts["verdict"] == "worse").sum())
    console.print(f"{worse} regressions" if worse else "no regression")
