"""The table of all runs, as columns of indices and numbers that are small in a page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from reports.tables import Tables, case_names, is_right
from workflows.outcomes import STARTED, comparable_times

MAX_RUNS = 30_000  # of a page; of more runs it lists those with an overlay
RIGHT, WRONG, NO_POSE, NOT_RUN = ANSWERS = ("right", "wrong", "no pose", "not run")
# Columns of words, stored once each, and of numbers.
WORDS = ("method", "model", "test", "case", "answer", "status")
NUMBERS = {
    "level": "level",
    "trial": "trial",
    "rmse": "rmse",
    "rotation": "rotation_error_deg",
    "time": "time_solve_s",
    "nodes": "n_nodes",
}


def listed(tables: Tables) -> pd.DataFrame:
    """Return the runs that the page lists, with ``case``, ``answer`` and times of one machine."""
    runs = tables.runs
    runs = runs.assign(
        case=case_names(runs), answer=answers(runs), time_solve_s=comparable_times(runs)
    )
    if len(runs) > MAX_RUNS:
        runs = runs[runs["run_id"].isin([item["run_id"] for item in tables.overlays])]
    return runs


def answers(runs: pd.DataFrame) -> pd.Series:
    """Return one of `ANSWERS` for each run."""
    found = pd.Series(WRONG, runs.index)
    found[is_right(runs)] = RIGHT
    found[runs["T_target_source"].eq("") & ~is_right(runs) & runs["rmse"].isna()] = NO_POSE
    found[~runs["outcome"].isin(STARTED)] = NOT_RUN
    return found


def columns(runs: pd.DataFrame, methods: Sequence[str], chunk_of: pd.Series) -> dict[str, Any]:
    """Return the columns of the table of runs: words as indices into ``words``, numbers as they are.

    Parameters
    ----------
    runs : DataFrame
        From `listed`.
    methods : sequence of str
        In the order of the page.
    chunk_of : Series
        By instance, the number of the file with the details of its runs.
    """
    words: dict[str, list[str]] = {}
    values: dict[str, list[Any]] = {"run": list(runs["run_id"])}
    known = {"method": methods, "answer": ANSWERS}
    for name in WORDS:
        order = known.get(name) or list(runs[name].unique())
        words[name] = list(order)
        values[name] = pd.Categorical(runs[name], categories=words[name]).codes.tolist()
    for name, column in NUMBERS.items():
        values[name] = [_short(value) for value in runs[column].tolist()]
    values["chunk"] = runs["instance_id"].map(chunk_of).tolist()
    return {"words": words, "values": values}


def _short(value: float) -> float | int | None:
    """Return a number with four digits, an integer if it is one; None if it is missing."""
    if value != value:
        return None
    short = float(f"{value:.4g}")
    return int(short) if short.is_integer() else short
