"""Record the small tables of a version, and compare a later version with them.

Verdicts, per experiment, method and metric:

- Work counters are integers that do not depend on the machine: a single differing run is a real change.
- A lost pose is a regression, whatever the cause.
- Quality (RMSE, objective, success) is paired over the same instances and judged by a sign test;
  a difference that may be due to chance is shown as ``unclear``.
- Runs that hit the time or memory limit are excluded from counters, RMSE and objective, as they end at
  another point in each execution; they count in poses, success and the certified share.
- Runs of a method that is not installed on one side are excluded.
- Times are compared within one machine only, and never fail a comparison.

Only the verdict ``worse`` is a regression.
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
from workflows.outcomes import TIMED

COUNTERS = ("n_nodes", "n_assignments")
QUALITY = ("rmse", "objective")
EXPERIMENTS = ("demo", "real2d")  # recorded by default
SAME = 1e-6  # relative difference up to which two floating-point results are equal
SIGNIFICANT = 0.05
NOTICEABLE = 1.2  # ratio of times


class CompareError(UserError):
    """Two sets of results cannot be compared; the message names file, value and remedy."""


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


# --- recording ---------------------------------------------------------------------------------


def results_to_record(results: Path = Path("results")) -> list[Path]:
    """Return the results of the experiments that are recorded by default."""
    folders = [results / name for name in EXPERIMENTS if (results / name / "tables").is_dir()]
    if not folders:
        raise CompareError(
            f"{results}: no results of {' or '.join(EXPERIMENTS)}; run one of them first"
        )
    return folders


def record(folder: Path, history: Path, version: str = "") -> Path:
    """Store the small table of an experiment under a version; return its folder."""
    runs = records.read(folder / "tables" / "runs.parquet", records.runs_columns())
    known = json.loads((folder / "tables" / "provenance.json").read_text(encoding="utf-8"))
    if known["selection"]:
        raise CompareError(
            f"{folder}: contains a part of the experiment ({known['selection']}); "
            "run and record the whole experiment"
        )
    version = version or provenance.default_version()
    out = history / version / known["experiment"]
    out.mkdir(parents=True, exist_ok=True)
    with whole_file(out / "runs.csv") as part:
        runs[list(records.recorded_columns())].to_csv(part, index=False)
    about = {key: known[key] for key in ("schema_version", "experiment", "machine", "versions")}
    about |= {"version": version, "git": known["git"], "created": known["created"]}
    with whole_file(out / "about.json") as part:
        part.write_text(json.dumps(about, indent=1), encoding="utf-8")
    return out


def read_version(name: str, history: Path) -> dict[str, pd.DataFrame]:
    """Read the tables of a recorded version, or of a folder of records, by experiment."""
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
    about = path.with_name("about.json")
    known = json.loads(about.read_text(encoding="utf-8")) if about.is_file() else {}
    version, commit = known.get("schema_version"), known.get("git", {}).get("commit")
    at_commit = f" at commit {commit}" if commit else ""
    records.check_version(version, str(path), f"run and record the experiment again{at_commit}")
    try:
        table = pd.read_csv(path, dtype={"instance_digest": str, "instance_id": str})
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise CompareError(f"{path}: not a readable table ({error}); record it again") from error
    missing = [column for column in records.recorded_columns() if column not in table]
    if missing:
        raise CompareError(f"{path}: column {missing[0]!r} is missing; record it again")
    return table


# --- comparing ---------------------------------------------------------------------------------


def compare(base: str, head: str, history: Path) -> pd.DataFrame:
    """Return the verdicts on all experiments that both versions have."""
    old, new = read_version(base, history), read_version(head, history)
    shared = [name for name in old if name in new]
    if not shared:
        raise CompareError(
            f"{base} has {', '.join(old)} and {head} has {', '.join(new)}: no experiment in common; "
            "record the same experiment for both"
        )
    verdicts = [
        verdict for name in shared for verdict in judge_experiment(name, old[name], new[name])
    ]
    if all(verdict.verdict == "not compared" for verdict in verdicts):
        raise CompareError(f"{base} and {head} share no instance; record both with the same config")
    return pd.DataFrame(map(asdict, verdicts))


def regressed(verdicts: pd.DataFrame) -> bool:
    """Whether any verdict is a regression."""
    return bool((verdicts["verdict"] == "worse").any())


def judge_experiment(name: str, base: pd.DataFrame, head: pd.DataFrame) -> Iterator[Verdict]:
    """Yield the verdicts on every method of one experiment."""
    for method in dict.fromkeys([*base["method"], *head["method"]]):
        yield from judge_method(
            name, method, base[base["method"] == method], head[head["method"] == method]
        )


def judge_method(
    experiment: str, method: str, base: pd.DataFrame, head: pd.DataFrame
) -> Iterator[Verdict]:
    """Yield the verdicts on one method, over the runs that both versions have with the same input."""
    keys = ["instance_id", "instance_digest", "n_inliers"]
    pairs = base.merge(head, on=keys, suffixes=("_base", "_head"), validate="one_to_one")
    absent = pairs[["status_base", "status_head"]].isin(["unavailable"]).any(axis=1)
    pairs = pairs[~absent]
    unmatched = len(base) + len(head) - 2 * len(pairs)
    excluded = f"{unmatched} runs without a counterpart" if unmatched else ""

    def verdict(
        metric: str, unit: str, better: str, old: float, new: float, word: str, why: str
    ) -> Verdict:
        detail = "; ".join(part for part in (why, excluded) if part)
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

    timed = pairs[["status_base", "status_head"]].isin(TIMED).any(axis=1)
    steady = pairs[~timed]
    note = f"{timed.sum()} runs at a time or memory limit excluded" if timed.any() else ""
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
    """Return ``same``, or ``better`` or ``worse`` if the difference is significant, else ``unclear``."""
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
    """Compare the numbers of lower bounds above the objective at the reference pose."""
    old, new = (int(pairs[f"bound_violation_{side}"].gt(0).sum()) for side in ("base", "head"))
    word = "worse" if new > old else "better" if new < old else "same"
    return old, new, word, ""


def _certified(pairs: pd.DataFrame) -> Judged:
    """Compare certificates; one lost to the time limit counts only if the run was also much slower."""
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
    return *means, word, f"ratio {ratio:.2f}; never a regression"


def _joined(*parts: str) -> str:
    return "; ".join(part for part in parts if part)


# --- printing ----------------------------------------------------------------------------------

STYLES = {"worse": "bold red", "better": "green", "changed": "yellow", "unclear": "yellow"}


def print_verdicts(verdicts: pd.DataFrame, base: str, head: str) -> None:
    """Print every verdict that is not ``same``, and a summary line."""
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
