"""The tables between stages: columns, their meaning, reading and writing. One schema, versioned.

Tables are Parquet files, those for readers CSV files too, and are written completely or not at all.
`runs_columns` describes the table from which reports, comparisons and notebooks start. Changing or
removing a column raises `SCHEMA_VERSION`; adding one does not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from workflows import UserError
from workflows.integrity import sealed_file
from workflows.outcomes import OUTCOMES

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

# 2: without n_bound_evals, which always equalled n_nodes.
# 3: success above the floor; errors and objective_true against the fit to the true pairs.
# 4: bounds "dc" and "interval", formerly "paper" and "edges".
# 5: status optimal needs a lower bound above 0 or an exact fit; gap_tol is the gap allowed at the end.
SCHEMA_VERSION = 5
RUN_AGAIN = "run the experiment again with `python -m workflows run EXPERIMENT`"


class Column(NamedTuple):
    kind: type
    meaning: str
    recorded: bool = False  # part of the table that `workflows.recording` keeps with a version
    is_added: bool = False  # by another package: earlier tables do not have it


class SchemaError(UserError):
    """A table does not have the documented form; the message names file, column and remedy."""


PLAN: dict[str, Column] = {
    "run_id": Column(str, "hash of instance, method, options, prior and limits", True),
    "chunk_id": Column(str, "file of instances and of raw results that contains this run"),
    "method": Column(str, "name of the method in the experiment (one line of the figures)", True),
    "baseline": Column(str, "folder of baselines/ that implements it"),
    "options": Column(str, "JSON of the options that differ from the card's defaults"),
    "options_effective": Column(
        str, "JSON of all options of the run: the card's defaults and those given"
    ),
    "instance_id": Column(
        str, "hash of dataset, shape, test, level, trial and number of points", True
    ),
    "dataset": Column(str, "folder of data/", True),
    "shape": Column(str, "shape or scene of the dataset", True),
    "test": Column(str, "disturbance or recorded test", True),
    "level": Column(float, "strength of the disturbance, in the units of the test", True),
    "trial": Column(int, "repetition, from 0", True),
    "model": Column(str, "similarity2d or rigid3d", True),
}

# What a solve job knows of a run: the solver's result and how it was obtained, no ground truth.
RAW: dict[str, Column] = {
    "run_id": Column(str, PLAN["run_id"].meaning, True),
    "instance_id": Column(str, PLAN["instance_id"].meaning, True),
    "instance_digest": Column(str, "hash of what the solver received, up to rounding", True),
    "n_source": Column(int, "points of the source"),
    "n_target": Column(int, "points of the target"),
    "n_inliers": Column(
        int,
        "number of pairs given to the solver: round(ratio * true number, or * number that the dataset "
        "prescribes)",
        True,
    ),
    "seed": Column(int, "seed for methods that draw random numbers"),
    "status": Column(str, "how the run ended, one of dcreg.Status", True),
    "message": Column(str, "reason of the status, or what ran (DC-Reg: mode and bound)", True),
    "T_target_source": Column(str, "JSON of the pose (rows of the homogeneous matrix), or empty"),
    "lower_bound": Column(float, "lower bound on the objective that the method certifies", True),
    "upper_bound": Column(float, "minimum value found of the certified objective, same unit", True),
    "gap": Column(float, "upper_bound - lower_bound", True),
    "gap_tol": Column(float, "absolute gap that counts as closed at the end of a run"),
    "bound_ratio": Column(float, "lower_bound / upper_bound; 1 for an exact fit", True),
    "certificate_scope": Column(str, "what the two bounds refer to"),
    "n_nodes": Column(float, "boxes bounded; empty for methods without a search", True),
    "n_assignments": Column(float, "exact assignments solved", True),
    "time_solve_s": Column(float, "wall time of the solver's own call", True),
    "time_warmup_s": Column(
        float, "imports and compilation of the run's worker, shared by its runs"
    ),
    "time_overhead_s": Column(float, "wall time of the run in the harness minus time_solve_s"),
    "peak_memory_mb": Column(float, "maximum resident memory of the worker during the run"),
    "fingerprint": Column(
        str,
        "declared version of the method, or the hash of code that is not known to give its results",
        True,
    ),
    "machine_id": Column(str, "hash of the machine card; times compare only within one", True),
    "parallel_jobs": Column(
        float, "maximum number of jobs that ran at the same time; empty if unknown (clusters)"
    ),
    "extra": Column(str, "JSON of further numbers that the method reports"),
}

TRACES: dict[str, Column] = {
    "run_id": Column(str, PLAN["run_id"].meaning),
    "method": Column(str, PLAN["method"].meaning),
    "instance_id": Column(str, PLAN["instance_id"].meaning),
    "stage": Column(str, "the search that emitted the event: search, rotation, ..."),
    "kind": Column(str, "bound: one of the two bounds changed; or end"),
    "time_s": Column(float, "time since the start of the solve"),
    "n_nodes": Column(float, "boxes bounded so far"),
    "n_assignments": Column(float, "exact assignments so far"),
    "n_open": Column(float, "open boxes or other regions"),
    "lower_bound": Column(float, "lower bound at that moment"),
    "upper_bound": Column(float, "value of the incumbent at that moment"),
}
RAW_TRACES = {name: column for name, column in TRACES.items() if name != "method"}


def runs_columns() -> dict[str, Column]:
    """Return the columns of ``tables/runs``: the plan, the raw results, and the metrics."""
    from workflows.attribution import COLUMNS
    from workflows.metrics import METRICS

    identity = {
        "schema_version": Column(int, "version of these columns"),
        "experiment": Column(str, "name of the experiment"),
        "display_name": Column(str, "name of the method in figures"),
        "provenance": Column(str, "official, library, port, reconstruction or own"),
        "n_inliers_ratio": Column(
            float,
            "given number of pairs over the true number, or over the number that the dataset prescribes",
        ),
        "n_inliers_true": Column(int, "number of true pairs (never given to a solver)"),
        "dim": Column(int, "2 or 3"),
        "noise_bound": Column(
            float,
            "inlier threshold given to all methods: 2 RMS residuals of the reference, or a minimum",
        ),
        "T_reference": Column(str, "JSON of the reference pose: the fit to the true pairs"),
        "outcome": Column(str, f"one of {', '.join(OUTCOMES)}"),
    }
    metrics = {
        name: Column(
            bool if metric.unit == "yes/no" and not metric.is_added else float,
            metric.meaning,
            metric.recorded and not metric.is_added,
            metric.is_added,
        )
        for name, metric in METRICS.items()
    }
    attribution = {name: Column(*column) for name, column in COLUMNS.items()}
    return {**identity, **PLAN, **RAW, **metrics, **attribution}


def recorded_columns() -> dict[str, Column]:
    """Return the columns that are kept with a version."""
    return {name: column for name, column in runs_columns().items() if column.recorded}


def check_version(version: Any, where: str, remedy: str) -> None:
    """Refuse results of another version of the schema.

    Raises
    ------
    SchemaError
    """
    if version != SCHEMA_VERSION:
        raise SchemaError(
            f"{where}: schema version {version}, but this checkout reads version {SCHEMA_VERSION}; "
            f"{remedy}"
        )


def frame(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Column]) -> pd.DataFrame:
    """Return a table of exactly these columns; absent numbers become NaN, absent texts empty."""
    import pandas as pd  # takes long to load, and a plan needs no tables

    table = pd.DataFrame(list(rows), columns=list(columns))
    return conform(table, columns, "new table")


def conform(table: pd.DataFrame, columns: Mapping[str, Column], where: str) -> pd.DataFrame:
    """Return the table with the documented columns, in order and of the documented kinds."""
    import pandas as pd

    if "schema_version" in columns:
        for version in table.get("schema_version", pd.Series([None])).unique():
            check_version(version, where, RUN_AGAIN)
    added = [name for name in columns if columns[name].is_added and name not in table]
    table = table.assign(**dict.fromkeys(added, math.nan)) if added else table
    missing = [name for name in columns if name not in table]
    if missing:
        raise SchemaError(
            f"{where}: column {missing[0]!r} is missing (schema version {SCHEMA_VERSION}); {RUN_AGAIN}"
        )
    out: dict[str, pd.Series] = {}
    for name, column in columns.items():
        values = table[name]
        try:
            if column.kind is float:
                out[name] = pd.to_numeric(values).astype(float)
            elif column.kind is str:
                is_text = isinstance(values.dtype, pd.StringDtype) and not values.hasnans
                out[name] = values if is_text else values.astype(object).fillna("").astype(str)
            else:
                out[name] = values.astype(column.kind)
        except (ValueError, TypeError) as error:
            raise SchemaError(
                f"{where}: column {name!r} ({column.meaning}) must hold "
                f"{column.kind.__name__}: {error}"
            ) from error
    return pd.DataFrame(out, index=table.index)


def scan(paths: Sequence[Path], columns: Sequence[str] = ()) -> pl.LazyFrame:
    """Return these columns, or all, of tables with the same columns, in the order of the paths.

    Raises
    ------
    SchemaError
        A table is missing.
    """
    import polars as pl

    for path in paths:
        if not path.is_file():
            raise SchemaError(f"{path}: no such table; {RUN_AGAIN}")
    table = pl.scan_parquet(list(paths), extra_columns="ignore")
    return table.select(columns) if columns else table


def conform_lazy(table: pl.LazyFrame, columns: Mapping[str, Column]) -> pl.LazyFrame:
    """Do the same for a table of Polars that is not in memory; empty numbers stay empty."""
    import polars as pl

    kinds = {float: pl.Float64, int: pl.Int64, str: pl.String, bool: pl.Boolean}
    cast = [pl.col(name).cast(kinds[column.kind]) for name, column in columns.items()]
    texts = [name for name, column in columns.items() if column.kind is str]
    return table.select(cast).with_columns(pl.col(texts).fill_null(""))


def write(table: pd.DataFrame, path: Path, *, csv: bool = False) -> None:
    """Write ``path`` as Parquet and, with `csv`, its CSV copy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with sealed_file(path) as part:
        table.to_parquet(part, index=False)
    if csv:
        with sealed_file(path.with_suffix(".csv")) as part:
            table.to_csv(part, index=False)


def read(path: Path, columns: Mapping[str, Column]) -> pd.DataFrame:
    """Read a table and check its version and columns."""
    import pandas as pd

    if not path.is_file():
        raise SchemaError(f"{path}: no such table; run the experiment first")
    return conform(pd.read_parquet(path), columns, str(path))
