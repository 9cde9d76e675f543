"""The tables a report is made of: loading, the checks that must hold, and the shared queries."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from data import registry
from data.contract import RecordedDataset
from workflows import records
from workflows.disturb import DISTURBANCES
from workflows.outcomes import OUTCOMES

PENALTY = 2.0  # of time limits, for runs that did not finish: PAR2


class ReportError(ValueError):
    """The tables do not add up or a file is missing; the message names file and remedy."""


@dataclass(frozen=True)
class Tables:
    """One experiment's tables, as written by the aggregate stage."""

    directory: Path
    runs: pd.DataFrame
    traces: pd.DataFrame
    accounting: pd.DataFrame
    provenance: dict[str, Any]
    overlays: list[dict[str, Any]]

    @classmethod
    def load(cls, directory: Path) -> Tables:
        """Read and check the tables in `directory`."""
        directory = Path(directory)
        path = directory / "accounting.csv"
        if not path.is_file():
            raise ReportError(f"{path}: no such table; run the aggregate stage first")
        tables = cls(
            directory=directory,
            # 2D first; beside that, models, tests and methods stay in the order of the plan
            runs=records.read(directory / "runs.parquet", records.runs_columns()).sort_values(
                "dim", kind="stable", ignore_index=True
            ),
            traces=records.read(directory / "traces.parquet", records.TRACES),
            accounting=pd.read_csv(path, keep_default_na=False),
            provenance=_read_json(directory / "provenance.json", {}),
            overlays=_read_json(directory / "overlays.json", []),
        )
        tables.check_accounting()
        return tables

    @property
    def cards(self) -> dict[str, dict[str, Any]]:
        """Method label -> card fields, options and availability."""
        return self.provenance.get("methods", {})

    def told_true_pairs(self, method: str) -> bool:
        """Whether a method is handed the true pairs, among random ones."""
        card = self.cards.get(method, {})
        settings = {**card.get("parameters", {}), **card.get("options", {})}
        return settings.get("front_end") == "oracle"

    @property
    def methods(self) -> list[str]:
        """Method labels in the order of the experiment's configuration."""
        present = list(dict.fromkeys(self.runs["method"]))
        known = [label for label in self.cards if label in present]
        return known + [label for label in present if label not in known]

    @property
    def experiment(self) -> str:
        return str(self.runs["experiment"].iloc[0])

    def check_accounting(self) -> None:
        """Planned runs equal the sum of their outcomes, in the ledger and in the runs alike."""
        path = self.directory / "accounting.csv"
        for column in ("method", "planned", *OUTCOMES):
            if column not in self.accounting:
                raise ReportError(
                    f"{path}: column {column!r} is missing; rebuild it with the aggregate stage"
                )
        counted = count_outcomes(self.runs)
        ledger = self.accounting.set_index("method")
        for method in sorted(set(counted.index) | set(ledger.index)):
            if method not in counted.index or method not in ledger.index:
                where = "runs" if method in ledger.index else path.name
                raise ReportError(
                    f"{path}: method {method!r} has no row in {where}; "
                    "rebuild the tables with the aggregate stage"
                )
            told, seen = ledger.loc[method], counted.loc[method]
            total = int(sum(told[outcome] for outcome in OUTCOMES))
            if int(told["planned"]) != total:
                raise ReportError(
                    f"{path}: {method}: planned = {told['planned']} but the outcomes sum to "
                    f"{total}; a run was dropped, rebuild the tables with the aggregate stage"
                )
            for column in ("planned", *OUTCOMES):
                if int(told[column]) != int(seen[column]):
                    raise ReportError(
                        f"{path}: {method}: {column} = {told[column]} but runs has "
                        f"{seen[column]}; rebuild the tables with the aggregate stage"
                    )


def count_outcomes(runs: pd.DataFrame) -> pd.DataFrame:
    """Planned runs and their outcomes per method (index: method)."""
    counts = pd.crosstab(runs["method"], runs["outcome"])
    counts = counts.reindex(columns=list(OUTCOMES), fill_value=0)
    counts.insert(0, "planned", runs.groupby("method").size())
    return counts


def counted_time(runs: pd.DataFrame, cards: dict[str, dict[str, Any]]) -> pd.Series:
    """Seconds of a run; one that ended at any limit or failed counts `PENALTY` times the time limit.

    Without a limit in the cards it counts `PENALTY` times what it took.
    """
    limits = {
        label: limit
        for label, card in cards.items()
        if (limit := card.get("limits", {}).get("time_s")) is not None
    }
    limit = runs["method"].map(limits).astype(float).fillna(runs["time_solve_s"])
    return runs["time_solve_s"].mask(runs["outcome"].isin(("limited", "failed")), PENALTY * limit)


def limits_of(card: dict[str, Any]) -> dict[str, str]:
    """What a run of a method may use, in words, by the status of a run that it ended."""
    limits = card.get("limits", {})
    boxes = {"nodes": "{:g} boxes or starts", "nodes_at_100": "{:g} boxes at 100 points"}
    texts = {
        "time_limit": {"time_s": "{:g} s"},
        "node_limit": boxes,
        "memory_limit": {"memory_mb": "{:g} MB"},
    }
    return {
        status: ", ".join(
            words.format(limits[key]) for key, words in keys.items() if limits.get(key)
        )
        for status, keys in texts.items()
        if any(limits.get(key) for key in keys)
    }


def row_names(runs: pd.DataFrame, most: int = 4) -> pd.Series:
    """The figure row each run belongs to: its shape, or its data set where shapes are many."""
    several = runs["dataset"].nunique() > 1
    crowded = runs.groupby("dataset")["shape"].transform("nunique") > most
    named = runs["dataset"] + " · " + runs["shape"] if several else runs["shape"]
    return named.where(~crowded, runs["dataset"])


def level_titles(runs: pd.DataFrame) -> dict[str, str]:
    """What the levels of each test measure, with their unit."""
    titles = {name: disturbance.label for name, disturbance in DISTURBANCES.items()}
    known = registry.datasets()
    for name in runs["dataset"].unique():
        if isinstance(recorded := known.get(name), RecordedDataset):
            titles |= {test: axis.label for test, axis in recorded.tests().items()}
    return {test: titles.get(test, "level") for test in runs["test"].unique()}


def thin_trace(events: pd.DataFrame, most: int = 200) -> pd.DataFrame:
    """The step changes of one bound history: first, last and every move of a bound.

    Longer histories keep `most` events, spread evenly over the logarithm of their position, so
    that early steps, which are many in little time, stay visible. No value is altered.
    """
    bounds = events[["lower_bound", "upper_bound"]]
    moved = (bounds != bounds.shift()).any(axis=1).to_numpy(copy=True)
    moved[[0, -1]] = True
    kept = events[moved]
    if len(kept) <= most:
        return kept
    index = np.unique(np.geomspace(1, len(kept), most).round().astype(int)) - 1
    return kept.iloc[index]


def _read_json(path: Path, empty: Any) -> Any:
    if not path.exists():
        return empty
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ReportError(f"{path}: not valid JSON ({error}); rebuild the tables") from error
