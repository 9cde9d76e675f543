"""Are the tables of two runs of an experiment the same, times apart? Row by row, to the last digit.

A run that differs is of one of five kinds (`KINDS`): the code of its method is another one; or the
clock ended it, so that it stood elsewhere this time; or its method does not repeat itself, and says so
on its card; or it differs in what it is measured by only, the best that any run found or certified on
its instance, and one of those differs; or none of these, which is a fault of the method or of the
harness.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from workflows import records
from workflows.attribution import COLUMNS
from workflows.compare import CLOCKED, CompareError

# Columns that two executions may differ in without a word.
TIMES = (
    "time_solve_s",
    "time_warmup_s",
    "time_overhead_s",
    "peak_memory_mb",
    "machine_id",
    "clocked",
    "random",
)
# Columns that set a run against all others on its instance.
AGAINST_OTHERS = ("objective_best", "objective_regret", *COLUMNS)
KINDS = {
    "code": "made by other code",
    "clock": "ended by the clock",
    "random": "not deterministic, as its card says",
    "others": "measured by others that differ",
    "unexplained": "for no reason known",
}


@dataclass(frozen=True)
class Differences:
    """What two tables of runs do not share.

    Attributes
    ----------
    n_runs : int
        Runs that both have.
    cells : DataFrame
        A row per run and column that differ: run_id, method, test, column, the two values, kind.
    alone : list of str
        Methods with runs that only one of the tables has.
    same_order : bool
        Whether the common runs stand in the same order.
    """

    n_runs: int
    cells: pd.DataFrame
    alone: list[str]
    same_order: bool

    @property
    def unexplained(self) -> bool:
        """Whether more differs than the clock and the cards account for."""
        kinds = {"unexplained", "code"} & set(self.cells["kind"])
        return bool(self.alone) or not self.same_order or bool(kinds)


def read(folder: Path) -> pd.DataFrame:
    """The table of runs of a folder of results, or of a part of it; the index is ``run_id``.

    Beside its columns it has ``clocked``: whether the run ended at its time, or at its memory; and
    ``random``: whether the card of its method says that it does not repeat itself.
    """
    path = folder / "tables" / "runs.parquet"
    if not path.is_file():
        raise CompareError(f"{path}: no such table; name the folder of an experiment's results")
    runs = records.read(path, records.runs_columns()).set_index("run_id", drop=False)
    cards = json.loads(path.with_name("provenance.json").read_text(encoding="utf-8"))["methods"]
    limits = {name: card.get("limits", {}).get("time_s", np.inf) for name, card in cards.items()}
    late = runs["time_solve_s"] >= runs["method"].map(limits)
    random = [name for name, card in cards.items() if not card.get("deterministic", True)]
    return runs.assign(
        clocked=runs["status"].isin(CLOCKED) | late, random=runs["method"].isin(random)
    )


def differences(one: pd.DataFrame, other: pd.DataFrame) -> Differences:
    """Compare two tables as `read` gives them."""
    common = one.index.intersection(other.index, sort=False)
    if common.empty:
        raise CompareError("the two have no run in common; run one config twice, unchanged")
    alone = pd.concat([one.drop(common), other.drop(common)])["method"]
    a, b = one.loc[common], other.loc[common]
    columns = [column for column in a if column not in TIMES]
    differs = pd.DataFrame({name: _differ(a[name], b[name]) for name in columns}, index=common)
    kinds = _kinds(differs, a, b)
    rows, at = np.nonzero(differs.to_numpy())
    cells = pd.DataFrame(
        {
            "run_id": common[rows],
            "method": a["method"].to_numpy()[rows],
            "test": a["test"].to_numpy()[rows],
            "column": np.array(columns, dtype=object)[at],
            "first": [a[columns[j]].iloc[i] for i, j in zip(rows, at, strict=True)],
            "second": [b[columns[j]].iloc[i] for i, j in zip(rows, at, strict=True)],
            "kind": kinds.to_numpy()[rows],
        }
    )
    order = list(common) == list(other.index.intersection(common, sort=False))
    return Differences(len(common), cells, list(dict.fromkeys(alone)), order)


def _differ(a: pd.Series, b: pd.Series) -> np.ndarray:
    """Where two columns differ; missing numbers are equal."""
    return ((a != b) & ~(a.isna() & b.isna())).to_numpy()


def _kinds(differs: pd.DataFrame, a: pd.DataFrame, b: pd.DataFrame) -> pd.Series:
    """One of `KINDS` for every run that differs."""
    clocked, random = a["clocked"] | b["clocked"], a["random"] | b["random"]
    other_code = differs["fingerprint"]
    by_itself = differs.drop(columns=list(AGAINST_OTHERS)).any(axis=1)
    neighbour = by_itself.groupby(a["instance_id"]).transform("any")
    kinds = np.select(
        [other_code, clocked, random, ~by_itself & neighbour],
        ["code", "clock", "random", "others"],
        "unexplained",
    )
    return pd.Series(kinds, index=differs.index)


def print_differences(found: Differences) -> None:
    """A line for every method, column and kind that differ, and one on the whole."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=140)
    table = Table("method", "column", "runs", "why", "for example", title_justify="left")
    for (kind, method), group in found.cells.groupby(["kind", "method"], sort=False):
        columns = list(dict.fromkeys(group["column"]))
        shown = ", ".join(columns[:6]) + (f" and {len(columns) - 6} more" if columns[6:] else "")
        cell = group.iloc[0]
        example = f"{cell.run_id}: {cell.column} {_short(cell['first'])} | {_short(cell['second'])}"
        runs = str(group["run_id"].nunique())
        table.add_row(str(method), shown, runs, KINDS[str(kind)], example)
    if len(found.cells):
        console.print(table, markup=False)
    for method in found.alone:
        console.print(f"{method}: runs that only one of the two has", markup=False)
    if not found.same_order:
        console.print("rows stand in another order")
    counts = found.cells.drop_duplicates("run_id")["kind"].value_counts()
    told = [f"{counts[kind]} {words}" for kind, words in KINDS.items() if kind in counts]
    console.print(
        f"{found.n_runs} runs, {counts.sum()} differ, times apart"
        + (f": {', '.join(told)}" if told else "")
    )


def _short(value: object) -> str:
    text = f"{value:.9g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 24 else f"{text[:23]}…"
