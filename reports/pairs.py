"""The user's own pairs of clouds: a row per pair and method instead of the claims of the paper."""

from __future__ import annotations

from typing import Any

from reports.runs.listed import answers
from reports.tables import Tables, is_right
from reports.theme import proven
from workflows.outcomes import attempted

OWN_TEST = "pair"  # the only test of a dataset of own pairs
SHOWN = [
    "run_id", "model", "shape", "method", "outcome", "status", "message", "success", "rmse",
    "rotation_error_deg", "translation_error", "time_solve_s", "bound_ratio", "certificate_scope",
    "T_target_source",
]  # fmt: skip


def is_own_data(tables: Tables) -> bool:
    """Return whether all runs are on pairs of clouds of the user's own."""
    return set(tables.runs["test"]) == {OWN_TEST}


def pair_rows(tables: Tables) -> list[dict[str, Any]]:
    """Return the attempted runs, pair by pair and the best pose first; empty for other data."""
    if not is_own_data(tables):
        return []
    runs = attempted(tables.runs[SHOWN])
    runs = runs.assign(right=is_right(runs), verdict=answers(runs)).sort_values(
        ["model", "shape", "right", "rmse"], ascending=[True, True, False, True], kind="stable"
    )
    rows = [{str(name): value for name, value in run.items()} for run in runs.to_dict("records")]
    return [{**row, "certificate": _certificate(row)} for row in rows]


def _certificate(run: dict[str, Any]) -> str:
    """Return what is proven: the optimum of an objective, or the share L/U."""
    if run["status"] == "optimal":
        return f"optimal: {run['certificate_scope']}" if run["certificate_scope"] else "optimal"
    ratio = run["bound_ratio"]
    return "" if ratio != ratio else f"L/U {proven(ratio)}"
