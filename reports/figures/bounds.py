"""Bound and gap histories of every certifying run, against time and against work."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pandas as pd

from dcreg.names import POSE_SCOPES
from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.tables import BOUNDS, Tables, row_names, thin_trace, thinned_positions
from reports.theme import Style, words
from workflows.outcomes import is_timed

if TYPE_CHECKING:
    import polars as pl

MAX_EVENTS = 60_000  # in one page; the rest is in the downloadable table


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Return the histories grouped by instance; None if no run has one."""
    events = lengths(tables.scan_traces())
    runs = tables.runs[tables.runs["run_id"].isin(events.index)]
    if runs.empty:
        return None
    runs = runs.assign(row=row_names(tables.runs), is_timed=is_timed(tables.runs)).sort_values(
        "trial", kind="stable"
    )
    sizes = runs["run_id"].map(events).groupby(runs["instance_id"], sort=False).sum()
    shown: list[str] = []
    left = MAX_EVENTS
    for instance, size in sizes.items():
        if size <= left or not shown:
            left -= size
            shown.append(str(instance))
    groups = runs[runs["instance_id"].isin(shown)].groupby("instance_id", sort=False)
    histories = _histories(
        tables.scan_traces(), [run for _, part in groups for run in part["run_id"]]
    )
    instances = [_instance(group, histories, styles) for _, group in groups]
    order = {
        "model": list(tables.runs["model"].unique()),
        "test": [words(test) for test in tables.runs["test"].unique()],
    }
    instances.sort(
        key=lambda item: (
            *(order[axis].index(item[axis]) for axis in order),
            item["shape"],
            item["level"],
            item["trial"],
        )
    )
    grid = Grid(column_titles=["against time", "against work"])
    for row, title in enumerate(("objective bounds", "gap")):
        for column in range(2):
            grid.add(Panel(row, column, "", title, "log", "log" if row else "linear", share_x=True))
    payload = {
        "instances": instances,
        "total": len(sizes),
        "start": max(range(len(instances)), key=lambda i: _length(instances[i])),
        "layouts": grid.layouts(),
        "scales": {
            "bounds": grid.axes("y", {0}),
            "gap": grid.axes("y", {1}),
            "x": grid.axes("x", {0, 1}),
        },
    }
    return Figure("bounds", "Bound and gap histories", "bounds", payload)


def lengths(traces: pl.LazyFrame) -> pd.Series:
    """Return the number of events of each run after `thin_trace`, summed over its stages."""
    import polars as pl

    changed = [(pl.col(name) != pl.col(name).shift()).fill_null(True) for name in BOUNDS]
    last = pl.int_range(pl.len()) == pl.len() - 1
    found = traces.group_by("run_id", "stage").agg(count=(changed[0] | changed[1] | last).sum())
    table = found.collect(engine="streaming").to_pandas()
    kept = {count: len(thinned_positions(count)) for count in table["count"].unique()}
    return table["count"].map(kept).groupby(table["run_id"]).sum()


def _histories(traces: pl.LazyFrame, run_ids: list[str]) -> dict[str, dict[str, pd.DataFrame]]:
    """Return the thinned histories of some runs, by run and stage."""
    import polars as pl

    events = traces.filter(pl.col("run_id").is_in(run_ids)).collect(engine="streaming").to_pandas()
    histories: dict[str, dict[str, pd.DataFrame]] = {}
    for (run_id, stage), part in events.groupby(["run_id", "stage"], sort=False):
        histories.setdefault(str(run_id), {})[str(stage)] = thin_trace(part)
    return histories


def _length(instance: dict[str, Any]) -> int:
    """Count the events of all methods in their first stage; the page opens with the longest history."""
    return sum(len(next(iter(run["stages"].values()))["time"]) for run in instance["runs"])


def _instance(
    group: pd.DataFrame,
    histories: dict[str, dict[str, pd.DataFrame]],
    styles: dict[str, Style],
) -> dict[str, Any]:
    first = group.iloc[0]
    return {
        "id": first["instance_id"],
        "model": first["model"],
        "shape": first["row"],
        "test": words(first["test"]),
        "level": first["level"],
        "trial": int(first["trial"]),
        "runs": [
            _run(run, histories[run["run_id"]], styles[run["method"]])
            for _, run in group.iterrows()
        ],
    }


def _run(run: pd.Series, stages: dict[str, pd.DataFrame], style: Style) -> dict[str, Any]:
    comparable = run["certificate_scope"] in POSE_SCOPES
    return {
        "run": run["run_id"],
        "method": run["method"],
        "status": run["status"],
        "scope": run["certificate_scope"],
        "n_inliers": run["n_inliers"],
        "gap_tol": run["gap_tol"],
        "truth": run["objective_true"] if comparable else None,
        "symbol": style.symbol,
        "dash": style.dash,
        "stages": {
            str(stage): {
                "time": list(part["time_s"]) if run["is_timed"] else [None] * len(part),
                "nodes": list(part["n_nodes"]),
                "assignments": list(part["n_assignments"]),
                "lower": list(part["lower_bound"].astype(float)),
                "upper": list(part["upper_bound"].astype(float)),
            }
            for stage, part in stages.items()
        },
    }
