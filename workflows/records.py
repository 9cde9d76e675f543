"""The tables between stages: columns, their meaning, reading and writing. One schema, versioned.

Tables are Parquet files, the ones for readers CSV files too, and are written whole or not at all.
`runs_columns` describes what a report, a comparison or a reader's own notebook starts from. A changed
or removed column raises `SCHEMA_VERSION`, a new one does not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from dcreg.files import whole_file
from dcreg.status import Status
from workflows import UserError

# 2: without n_bound_evals, which always equalled n_nodes. 3: success above the floor; errors of the
# pose and objective_true against the fit to the true pairs, no longer the pose before the warp.
SCHEMA_VERSION = 3


class Column(NamedTuple):
    kind: type
    meaning: str


class SchemaError(UserError):
    """A table does not have the documented form; the message names file, column and remedy."""


PLAN: dict[str, Column] = {
    "run_id": Column(str, "hash of instance, method, options, prior and limits"),
    "chunk_id": Column(str, "file of instances and of raw results this run is in"),
    "method": Column(str, "name of the method in the experiment (one line of the figures)"),
    "baseline": Column(str, "folder of baselines/ that implements it"),
    "options": Column(str, "JSON of the options that differ from the card's defaults"),
    "instance_id": Column(str, "hash of dataset, shape, test, level, trial and number of points"),
    "dataset": Column(str, "folder of data/"),
    "shape": Column(str, "shape or scene of the dataset"),
    "test": Column(str, "disturbance or recorded test"),
    "level": Column(float, "strength of the disturbance, in the units of the test"),
    "trial": Column(int, "repetition, from 0"),
    "model": Column(str, "similarity2d or rigid3d"),
}

# What a solve job knows of a run: the solver's answer and how it was obtained, no truth.
RAW: dict[str, Column] = {
    "run_id": Column(str, PLAN["run_id"].meaning),
    "instance_id": Column(str, PLAN["instance_id"].meaning),
    "instance_digest": Column(str, "hash of the content the solver was given"),
    "n_source": Column(int, "points of the source"),
    "n_target": Column(int, "points of the target"),
    "n_inliers": Column(
        int, "pairs the solver was told: round(ratio * true count, or that of the data set's rule)"
    ),
    "seed": Column(int, "seed given to methods that draw random numbers"),
    "status": Column(str, "how the run ended, one of dcreg.Status"),
    "message": Column(str, "why the run ended so, or what ran (DC-Reg: mode and bound)"),
    "T_target_source": Column(str, "JSON of the pose (rows of the homogeneous matrix), or empty"),
    "lower_bound": Column(float, "bound on the objective the method certifies (see its card)"),
    "upper_bound": Column(float, "least value found of the certified objective, same unit"),
    "gap": Column(float, "upper_bound - lower_bound"),
    "gap_tol": Column(float, "absolute tolerance of the gap at which a run is optimal"),
    "certificate_scope": Column(str, "what the two bounds speak of"),
    "n_nodes": Column(float, "boxes bounded; empty for methods without a search"),
    "n_assignments": Column(float, "exact assignments solved"),
    "time_solve_s": Column(float, "wall time of the solver's own call"),
    "time_warmup_s": Column(float, "imports and JIT of the worker that made the run, shared by it"),
    "time_overhead_s": Column(float, "wall time of the run in the harness less time_solve_s"),
    "peak_memory_mb": Column(float, "most resident memory of the worker during the run"),
    "fingerprint": Column(str, "hash of the sources that decide the method's results"),
    "machine_id": Column(str, "hash of the machine card; times compare within one only"),
    "parallel_jobs": Column(float, "most jobs the harness ran beside each other"),
    "extra": Column(str, "JSON of further numbers the method reports"),
}

TRACES: dict[str, Column] = {
    "run_id": Column(str, PLAN["run_id"].meaning),
    "method": Column(str, PLAN["method"].meaning),
    "instance_id": Column(str, PLAN["instance_id"].meaning),
    "stage": Column(str, "the search that speaks: search, rotation, ..."),
    "kind": Column(str, "bound: one of the two moved; or end"),
    "time_s": Column(float, "time since the solve began"),
    "n_nodes": Column(float, "boxes bounded so far"),
    "n_assignments": Column(float, "exact assignments so far"),
    "n_open": Column(float, "boxes, or other regions, waiting"),
    "lower_bound": Column(float, "bound at that moment"),
    "upper_bound": Column(float, "value of the incumbent at that moment"),
}
RAW_TRACES = {name: column for name, column in TRACES.items() if name != "method"}


def runs_columns() -> dict[str, Column]:
    """Columns of ``tables/runs``: the plan, the raw results, and the metrics."""
    from workflows.attribution import COLUMNS
    from workflows.metrics import METRICS

    identity = {
        "schema_version": Column(int, "version of these columns"),
        "experiment": Column(str, "name of the experiment"),
        "display_name": Column(str, "how figures call the method"),
        "provenance": Column(str, "official, library, port or reconstruction"),
        "n_inliers_ratio": Column(
            float,
            "share of the true pairs, or of the number of the data set's rule, that the solver was told",
        ),
        "n_inliers_true": Column(int, "true pairs (never seen by a solver)"),
        "dim": Column(int, "2 or 3"),
        "noise_bound": Column(
            float,
            "inlier threshold told to all methods: 2 RMS residuals of the reference, or a floor",
        ),
        "T_reference": Column(str, "JSON of the reference pose: the fit to the true pairs"),
        "outcome": Column(str, "finished, limited, failed, unsupported or unavailable"),
    }
    metrics = {
        name: Column(bool if metric.unit == "yes/no" else float, metric.meaning)
        for name, metric in METRICS.items()
    }
    attribution = {name: Column(*column) for name, column in COLUMNS.items()}
    return {**identity, **PLAN, **RAW, **metrics, **attribution}


def outcome(status: str) -> str:
    """The share of the accounting that a status belongs to."""
    match Status(status):
        case Status.OPTIMAL | Status.CONVERGED:
            return "finished"
        case Status.TIME_LIMIT | Status.NODE_LIMIT | Status.MEMORY_LIMIT | Status.STOPPED:
            return "limited"
        case Status.FAILED | Status.UNSUPPORTED | Status.UNAVAILABLE as other:
            return other.value
    raise SchemaError(f"status {status!r} of a run cannot be accounted for; solve it again")


def frame(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Column]) -> pd.DataFrame:
    """A table of exactly these columns; absent numbers become NaN, absent texts empty."""
    table = pd.DataFrame(list(rows), columns=list(columns))
    return conform(table, columns, "new table")


def conform(table: pd.DataFrame, columns: Mapping[str, Column], where: str) -> pd.DataFrame:
    """The table with the documented columns, in order and of the documented kinds."""
    missing = [name for name in columns if name not in table]
    if missing:
        raise SchemaError(
            f"{where}: column {missing[0]!r} is missing (schema version {SCHEMA_VERSION}); "
            "make it again with this version"
        )
    out: dict[str, pd.Series] = {}
    for name, column in columns.items():
        values = table[name]
        try:
            if column.kind is float:
                out[name] = pd.to_numeric(values).astype(float)
            elif column.kind is str:
                out[name] = values.astype(object).fillna("").astype(str)
            else:
                out[name] = values.astype(column.kind)
        except (ValueError, TypeError) as error:
            raise SchemaError(
                f"{where}: column {name!r} ({column.meaning}) must hold "
                f"{column.kind.__name__}: {error}"
            ) from error
    return pd.DataFrame(out, index=table.index)


def write(table: pd.DataFrame, path: Path, *, csv: bool = False) -> None:
    """Write ``path`` (Parquet), and its CSV twin where asked."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        table.to_parquet(part, index=False)
    if csv:
        with whole_file(path.with_suffix(".csv")) as part:
            table.to_csv(part, index=False)


def read(path: Path, columns: Mapping[str, Column]) -> pd.DataFrame:
    """Read a table and check that it has the documented form."""
    if not path.is_file():
        raise SchemaError(f"{path}: no such table; run the stage that writes it first")
    return conform(pd.read_parquet(path), columns, str(path))
