"""Compare the tables of two executions of an experiment run by run and digit by digit, times aside.

Each run that differs gets one reason (`REASONS`): the code of its method changed; it hit the time or
memory limit; its method is not deterministic, as its card states; the two runs are from different
machines; or only its comparison with other runs on its instance differs, and one of those runs differs.
A run without any of these reasons shows a fault of the method or of the harness.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from workflows import records
from workflows.attribution import COLUMNS
from workflows.compare import CompareError
from workflows.integrity import refuse_damaged
from workflows.outcomes import TIMED

# Columns that may differ between two executions.
TIMES = (
    "time_solve_s",
    "time_warmup_s",
    "time_overhead_s",
    "peak_memory_mb",
    "machine_id",
    "parallel_jobs",
    "is_timed",
    "is_random",
)
# Columns that compare a run with all others on its instance.
RELATIVE = ("objective_best", "objective_regret", *COLUMNS)
REASONS = {
    "code": "the code of the method differs",
    "limit": "hit the time or memory limit",
    "random": "not deterministic, as its card states",
    "machine": "from another machine, whose rounding can differ",
    "others": "relative to another run, which differs",
    "unexplained": "unexplained",
}


@dataclass(frozen=True)
class Differences:
    """The differences between two tables of runs.

    Attributes
    ----------
    n_runs : int
        Runs that both have.
    cells : DataFrame
        A row per run and column that differ: run_id, method, test, column, the two values, reason.
    unmatched : list of str
        Methods with runs that only one of the tables has.
    same_order : bool
        Whether the common runs are in the same order.
    """

    n_runs: int
    cells: pd.DataFrame
    unmatched: list[str]
    same_order: bool

    @property
    def unexplained(self) -> bool:
        """Whether limits and cards do not explain all differences."""
        reasons = {"unexplained", "code"} & set(self.cells["reason"])
        return bool(self.unmatched) or not self.same_order or bool(reasons)


def read(folder: Path) -> pd.DataFrame:
    """Read the table of runs of a folder of results, or of a part of it, indexed by ``run_id``.

    Two columns are added. ``is_timed``: the run ended at the time or memory limit. ``is_random``: its
    method is not deterministic, as its card states. Times are removed from the column ``extra``.
    """
    path = folder / "tables" / "runs.parquet"
    if not path.is_file():
        raise CompareError(f"{path}: no such table; name the folder of an experiment's results")
    refuse_damaged(path.parent)
    runs = records.read(path, records.runs_columns()).set_index("run_id", drop=False)
    cards = json.loads(path.with_name("provenance.json").read_text(encoding="utf-8"))["methods"]
    limits = {name: card.get("limits", {}).get("time_s", np.inf) for name, card in cards.items()}
    late = runs["time_solve_s"] >= runs["method"].map(limits)
    random = [name for name, card in cards.items() if not card.get("deterministic", True)]
    return runs.assign(
        extra=runs["extra"].map(_without_times),
        is_timed=runs["status"].isin(TIMED) | late,
        is_random=runs["method"].isin(random),
    )


def _without_times(extra: str) -> str:
    facts = json.loads(extra or "{}")
    return json.dumps({key: value for key, value in facts.items() if not key.startswith("time_")})


def differences(one: pd.DataFrame, other: pd.DataFrame) -> Differences:
    """Compare two tables that `read` returned."""
    common = one.index.intersection(other.index, sort=False)
    if common.empty:
        raise CompareError(
            "the two have no run in common; run the same config twice without changes"
        )
    unmatched = pd.concat([one.drop(common), other.drop(common)])["method"]
    a, b = one.loc[common], other.loc[common]
    columns = [column for column in a if column not in TIMES]
    differs = pd.DataFrame({name: _differ(a[name], b[name]) for name in columns}, index=common)
    reasons = _reasons(differs, a, b)
    rows, at = np.nonzero(differs.to_numpy())
    cells = pd.DataFrame(
        {
            "run_id": common[rows],
            "method": a["method"].to_numpy()[rows],
            "test": a["test"].to_numpy()[rows],
            "column": np.array(columns, dtype=object)[at],
            "first": [a[columns[j]].iloc[i] for i, j in zip(rows, at, strict=True)],
            "second": [b[columns[j]].iloc[i] for i, j in zip(rows, at, strict=True)],
            "reason": reasons.to_numpy()[rows],
        }
    )
    order = list(common) == list(other.index.intersection(common, sort=False))
    return Differences(len(common), cells, list(dict.fromkeys(unmatched)), order)


def _differ(a: pd.Series, b: pd.Series) -> np.ndarray:
    """Where two columns differ; missing numbers are equal."""
    return ((a != b) & ~(a.isna() & b.isna())).to_numpy()


def _reasons(differs: pd.DataFrame, a: pd.DataFrame, b: pd.DataFrame) -> pd.Series:
    """One of `REASONS` for every run that differs."""
    by_itself = differs.drop(columns=list(RELATIVE)).any(axis=1)
    neighbour = by_itself.groupby(a["instance_id"]).transform("any")
    conditions = {
        "code": differs["fingerprint"],
        "limit": a["is_timed"] | b["is_timed"],
        "random": a["is_random"] | b["is_random"],
        "machine": a["machine_id"] != b["machine_id"],
        "others": ~by_itself & neighbour,
    }
    reasons = np.select(list(conditions.values()), list(conditions), "unexplained")
    return pd.Series(reasons, index=differs.index)


def print_differences(found: Differences) -> None:
    """Print a row per method and reason, and a summary line."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=140)
    table = Table("method", "columns", "runs", "reason", "example", title_justify="left")
    for (reason, method), group in found.cells.groupby(["reason", "method"], sort=False):
        columns = list(dict.fromkeys(group["column"]))
        shown = ", ".join(columns[:6]) + (f" and {len(columns) - 6} more" if columns[6:] else "")
        cell = group.iloc[0]
        example = f"{cell.run_id}: {cell.column} {_short(cell['first'])} | {_short(cell['second'])}"
        runs = str(group["run_id"].nunique())
        table.add_row(str(method), shown, runs, REASONS[str(reason)], example)
    if len(found.cells):
        console.print(table, markup=False)
    for method in found.unmatched:
        console.print(f"{method}: runs that only one of the two has", markup=False)
    if not found.same_order:
        console.print("the rows are in another order")
    counts = found.cells.drop_duplicates("run_id")["reason"].value_counts()
    parts = [f"{counts[name]} {text}" for name, text in REASONS.items() if name in counts]
    console.print(
        f"{found.n_runs} runs, {counts.sum()} differ, times aside"
        + (f": {', '.join(parts)}" if parts else "")
    )


def _short(value: object) -> str:
    text = f"{value:.9g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 24 else f"{text[:23]}…"
