"""The tables of a report: loading, checks, and shared queries."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from data import registry
from data.contract import RecordedDataset
from dcreg.names import NORM_SCOPES, POSE_SCOPES
from workflows import UserError, records
from workflows.disturb import DISTURBANCES
from workflows.integrity import readable, refuse_damaged
from workflows.outcomes import NOT_NEEDED, OUTCOMES, STARTED
from workflows.stages.aggregate import REPLAY
from workflows.studies import REFERENCE

if TYPE_CHECKING:
    import polars as pl

COVERAGE = 0.95
BOUNDS = ("lower_bound", "upper_bound")
MOST_EVENTS = 200  # of a bound history in a figure
STORED_EVENTS = 64  # of one in an archive, and where searches are compared by their histories
PENALTY = 2.0  # time limits that a run without the right pose counts (PAR2)


class ReportError(UserError):
    """The tables do not add up or a file is missing; the message names file and remedy."""


@dataclass(frozen=True)
class Tables:
    """One experiment's tables, as written by the aggregate stage."""

    directory: Path
    runs: pd.DataFrame
    accounting: pd.DataFrame
    provenance: dict[str, Any]
    overlays: list[dict[str, Any]]
    histories: pd.DataFrame | None = None  # if they are not in the file of `directory`

    @classmethod
    def load(cls, directory: Path) -> Tables:
        """Read and check the tables in `directory`.

        Raises
        ------
        ReportError, SchemaError, DamagedError
        """
        directory = Path(directory)
        path = directory / "accounting.csv"
        if not path.is_file():
            raise ReportError(f"{path}: no such table; run the experiment first")
        refuse_damaged(directory)
        tables = cls(
            directory=directory,
            runs=_read_runs(directory / "runs.parquet"),
            accounting=pd.read_csv(path, keep_default_na=False, dtype={"method": str}),
            provenance=_read_json(directory / "provenance.json", {}),
            overlays=_read_json(directory / "overlays.json", []),
        )
        tables.check_accounting()
        return tables

    @cached_property
    def is_of_blocks(self) -> bool:
        """Whether methods ran only on the blocks that some claim needed (`workflows.blocks`)."""
        return bool((self.runs["outcome"] == NOT_NEEDED).any())

    @cached_property
    def traces(self) -> pd.DataFrame:
        """All bound histories; they may need more memory than the runs."""
        if self.histories is not None:
            return self.histories
        return records.read(self.directory / "traces.parquet", records.TRACES)

    def scan_traces(self) -> pl.LazyFrame:
        """Return the bound histories for queries that need not hold them in memory."""
        import polars as pl

        if self.histories is not None:
            return pl.from_pandas(self.histories).lazy()
        path = self.directory / "traces.parquet"
        if not path.is_file():
            raise ReportError(f"{path}: no such table; run the experiment first")
        return records.conform_lazy(pl.scan_parquet(path), records.TRACES)

    def count_events(self) -> int:
        """Count the events of all bound histories."""
        import polars as pl

        return int(self.scan_traces().select(pl.len()).collect().item())

    @property
    def cards(self) -> dict[str, dict[str, Any]]:
        """Card fields, options and availability by method label."""
        return self.provenance.get("methods", {})

    def is_oracle(self, method: str) -> bool:
        """Whether a method receives the true pairs, among random ones."""
        card = self.cards.get(method, {})
        settings = {**card.get("parameters", {}), **card.get("options", {})}
        return settings.get("front_end") == "oracle"

    @property
    def methods(self) -> list[str]:
        """Method labels in the order of the experiment's config."""
        present = list(self.runs["method"].unique())
        known = [label for label in self.cards if label in present]
        return known + [label for label in present if label not in known]

    @property
    def replay_command(self) -> str:
        """The command that repeats a run of these tables, without the run."""
        recorded = str(self.provenance.get("replay", ""))
        # earlier tables name another one
        return recorded if recorded.startswith(REPLAY) else f"{REPLAY} RUN="

    @property
    def experiment(self) -> str:
        return str(self.runs["experiment"].iloc[0])

    def check_accounting(self) -> None:
        """Check that planned runs equal the sum of their outcomes, in the accounting and in the runs."""
        path = self.directory / "accounting.csv"
        for column in ("method", "planned", *OUTCOMES):
            if column not in self.accounting:
                raise ReportError(f"{path}: column {column!r} is missing; run the experiment again")
        counted = count_outcomes(self.runs)
        ledger = self.accounting.set_index("method")
        for method in sorted(set(counted.index) | set(ledger.index)):
            if method not in counted.index or method not in ledger.index:
                where = "runs" if method in ledger.index else path.name
                raise ReportError(
                    f"{path}: method {method!r} has no row in {where}; run the experiment again"
                )
            stated, seen = ledger.loc[method], counted.loc[method]
            total = int(sum(stated[outcome] for outcome in OUTCOMES))
            if int(stated["planned"]) != total:
                raise ReportError(
                    f"{path}: {method}: planned = {stated['planned']} but the outcomes sum to "
                    f"{total}; a run was dropped, run the experiment again"
                )
            for column in ("planned", *OUTCOMES):
                if int(stated[column]) != int(seen[column]):
                    raise ReportError(
                        f"{path}: {method}: {column} = {stated[column]} but runs has "
                        f"{seen[column]}; run the experiment again"
                    )


def check_study(table: pd.DataFrame, folder: Path) -> None:
    """Refuse tables of the study of bounds of an earlier version.

    Raises
    ------
    ReportError
    """
    lacks = [f"bound {REFERENCE!r}"] * (REFERENCE not in set(table["bound"]))
    lacks += ["column 'trial'"] * ("trial" not in table)
    if lacks:
        raise ReportError(
            f"{folder}: no {lacks[0]} in its tables, which an earlier version wrote; "
            "make them again with `make bounds`"
        )


def count_outcomes(runs: pd.DataFrame) -> pd.DataFrame:
    """Count planned runs and their outcomes per method (index: method)."""
    counts = pd.crosstab(runs["method"], runs["outcome"])
    counts = counts.reindex(columns=list(OUTCOMES), fill_value=0)
    counts.insert(0, "planned", runs.groupby("method").size())
    return counts


def counted_time(runs: pd.DataFrame, cards: dict[str, dict[str, Any]]) -> pd.Series:
    """Return the seconds of runs; a run without the right pose counts `PENALTY` times the time limit.

    That is the longest limit of any method, so the penalty is the same for all.
    """
    limits = [card.get("limits", {}).get("time_s") for card in cards.values()]
    longest = max(filter(None, limits), default=runs["time_solve_s"].max())
    return runs["time_solve_s"].where(is_right(runs), PENALTY * longest)


def is_right(runs: pd.DataFrame) -> pd.Series:
    """Return whether each run found the right pose; a run without a pose did not."""
    return runs["success"].astype(float).fillna(0) > 0


def share_interval(right: int, runs: int) -> tuple[float, float]:
    """Return the ends of Wilson's 95 % interval of a share."""
    low, high = share_intervals(np.array(right), runs)
    return float(low), float(high)


def share_intervals(right: np.ndarray, runs: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of Wilson's 95 % intervals of shares of the same number of runs."""
    share, z = right / runs, NormalDist().inv_cdf((1 + COVERAGE) / 2)
    centre = share + z**2 / (2 * runs)
    half = z * np.sqrt(share * (1 - share) / runs + (z / (2 * runs)) ** 2)
    low, high = ((centre + side * half) / (1 + z**2 / runs) for side in (-1, 1))
    return np.where(right > 0, low, 0.0), np.where(right < runs, high, 1.0)


def limits_of(card: dict[str, Any]) -> dict[str, str]:
    """Return the limits of a method in words, by the status of a run that hits them."""
    limits = card.get("limits", {})
    texts = {
        "time_limit": {"time_s": "{:g} s"},
        "node_limit": {"nodes": "{:g} boxes or initial poses"},
        "assignment_limit": {"assignments": "{:g} assignments"},
        "memory_limit": {"memory_mb": "{:g} MB"},
    }
    return {
        status: ", ".join(
            words.format(limits[key]) for key, words in keys.items() if limits.get(key)
        )
        for status, keys in texts.items()
        if any(limits.get(key) for key in keys)
    }


def reason(status: str, message: str, card: dict[str, Any]) -> str:
    """Return why a run ended as it did: the limit that it hit, or its message."""
    if limit := limits_of(card).get(status):
        return f"hit its limit of {limit}" + (f" ({message})" if message else "")
    return message or "no reason given"


def case_names(runs: pd.DataFrame) -> pd.Series:
    """Return the name of the data of each run: its shape, with its dataset if there are several."""
    if runs["dataset"].nunique() == 1:
        return runs["shape"]
    named = runs["dataset"] + " · " + runs["shape"]
    return named.mask(runs["dataset"] == runs["shape"], runs["shape"])  # not "horse · horse"


def row_names(runs: pd.DataFrame, most: int = 4) -> pd.Series:
    """Return the figure row of each run: its shape, or its dataset if there are many shapes."""
    crowded = runs.groupby("dataset")["shape"].transform("nunique") > most
    return case_names(runs).where(~crowded, runs["dataset"])


def level_titles(runs: pd.DataFrame) -> dict[str, str]:
    """Return what the levels of each test measure, with their unit."""
    titles = {name: disturbance.label for name, disturbance in DISTURBANCES.items()}
    known = registry.datasets()
    for name in runs["dataset"].unique():
        if isinstance(recorded := known.get(name), RecordedDataset):
            titles |= {test: axis.label for test, axis in recorded.tests().items()}
    return {test: titles.get(test, "level") for test in runs["test"].unique()}


def thin_trace(events: pd.DataFrame, most: int = MOST_EVENTS) -> pd.DataFrame:
    """Return the first, the last and every event of a bound history in which a bound changes.

    Longer histories keep `most` events, spread evenly over the logarithm of their position, so that the
    many early changes stay visible. No value is altered.
    """
    kept = events[_moved(events[list(BOUNDS)].to_numpy())]
    return kept.iloc[thinned_positions(len(kept), most)]


def thinned(traces: pd.DataFrame) -> pd.DataFrame:
    """Return bound histories with at most `STORED_EVENTS` events a run, in the order of the runs.

    The last event of every stage is kept.
    """
    if traces.empty:
        return traces
    groups = traces.groupby("run_id", sort=False)
    return pd.concat([_thinned(part) for _, part in groups], ignore_index=True)


def _thinned(events: pd.DataFrame) -> pd.DataFrame:
    return events.iloc[
        stored_positions(events["stage"].to_numpy(), events[list(BOUNDS)].to_numpy())
    ]


def stored_positions(stage: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return the positions that `thinned` keeps of a history with (E,) stages and (E, 2) bounds."""
    ends = np.array(sorted({name: at for at, name in enumerate(stage)}.values()))
    kept = np.flatnonzero(_moved(bounds))
    return np.union1d(kept[thinned_positions(len(kept), STORED_EVENTS - len(ends))], ends)


def _moved(bounds: np.ndarray) -> np.ndarray:
    """Tell of the first, the last and every event in which a bound changes."""
    moved = np.ones(len(bounds), dtype=bool)
    moved[1:-1] = (bounds[1:-1] != bounds[:-2]).any(axis=1)
    return moved


def is_refuted(runs: pd.DataFrame) -> pd.Series:
    """Tell of each run whether its lower bound exceeds a known objective: its certificate is wrong."""
    best = runs["objective_best"] * (1 + 1e-9) + 1e-12
    # the bounds of other scopes are on other objectives
    is_comparable = runs["certificate_scope"].isin((*POSE_SCOPES, *NORM_SCOPES))
    return is_comparable & ((runs["bound_violation"] > 0) | (runs["lower_bound"] > best))


def started_in(place: Path) -> int:
    """Return the number of started runs in the tables of a folder of results; -1 without tables."""
    path = place / "tables" / "accounting.csv"
    if not path.is_file():
        return -1
    with readable(path):
        return int(pd.read_csv(path)[list(STARTED)].to_numpy().sum())


def thinned_positions(count: int, most: int = MOST_EVENTS) -> np.ndarray:
    """Return the positions that `thin_trace` keeps of `count` events in which a bound changes."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.geomspace(1, count, most).round().astype(int)) - 1


def _read_runs(path: Path) -> pd.DataFrame:
    """Return the table of runs, 2D first; otherwise in the order of the plan."""
    import polars as pl

    if not path.is_file():
        raise records.SchemaError(f"{path}: no such table; run the experiment first")
    columns = records.runs_columns()
    with readable(path):
        table = pl.scan_parquet(path)
        known = table.select(name for name in table.collect_schema() if name in columns)
        has_dim = "dim" in known.collect_schema()
        ordered = known.sort("dim", maintain_order=True) if has_dim else known
        runs = ordered.collect().to_pandas()
    return records.conform(runs, columns, str(path))


def _read_json(path: Path, empty: Any) -> Any:
    if not path.exists():
        return empty
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ReportError(f"{path}: not valid JSON ({error}); run the experiment again") from error
    if not isinstance(content, type(empty)):
        kind = type(empty).__name__
        raise ReportError(
            f"{path}: must hold a {kind}, not {content!r:.40}; run the experiment again"
        )
    return content
