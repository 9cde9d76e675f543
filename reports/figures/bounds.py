"""Bound and gap histories of every certifying run, against time and against work."""

from __future__ import annotations

from typing import Any

import pandas as pd

from dcreg.names import POSE_SCOPES
from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.tables import Tables, row_names, thin_trace
from reports.theme import Style, words

MAX_EVENTS = 60_000  # in one page; the rest is in the downloadable table


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Return the histories grouped by instance; None if no run has one."""
    traced = tables.traces[tables.traces["run_id"].isin(set(tables.runs["run_id"]))]
    if traced.empty:
        return None
    runs = tables.runs[tables.runs["run_id"].isin(set(traced["run_id"]))]
    runs = runs.assign(row=row_names(tables.runs)).sort_values("trial", kind="stable")
    histories: dict[str, dict[str, pd.DataFrame]] = {}
    for (run_id, stage), part in traced.groupby(["run_id", "stage"], sort=False):
        histories.setdefault(str(run_id), {})[str(stage)] = thin_trace(part)
    instances: list[dict[str, Any]] = []
    left, total = MAX_EVENTS, runs["instance_id"].nunique()
    for _, group in runs.groupby("instance_id", sort=False):
        size = sum(len(part) for run_id in group["run_id"] for part in histories[run_id].values())
        if size > left and instances:
            continue
        left -= size
        instances.append(_instance(group, histories, styles))
    order = {
        "model": list(dict.fromkeys(tables.runs["model"])),
        "test": [words(test) for test in dict.fromkeys(tables.runs["test"])],
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
        "total": total,
        "start": max(range(len(instances)), key=lambda i: _length(instances[i])),
        "layouts": grid.layouts(),
        "scales": {
            "bounds": grid.axes("y", {0}),
            "gap": grid.axes("y", {1}),
            "x": grid.axes("x", {0, 1}),
        },
    }
    return Figure("bounds", "Bound and gap histories", "bounds", payload)


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
        "stages": {
            str(stage): {
                "time": list(part["time_s"]),
                "nodes": list(part["n_nodes"]),
                "assignments": list(part["n_assignments"]),
                "lower": list(part["lower_bound"].astype(float)),
                "upper": list(part["upper_bound"].astype(float)),
            }
            for stage, part in stages.items()
        },
    }
