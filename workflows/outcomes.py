"""The groups of statuses: what each means for the accounting, and whether a repetition has it too."""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np
import pandas as pd

from dcreg.status import Status
from workflows import UserError


class Group(NamedTuple):
    """What a status means for the accounting and for comparisons."""

    outcome: str
    is_timed: bool = False  # time or memory decided: another execution may end elsewhere


NOT_NEEDED = "not_needed"  # left out, because no block so far contains it
GROUPS: dict[Status, Group] = {
    Status.OPTIMAL: Group("finished"),
    Status.CONVERGED: Group("finished"),
    Status.REFUTED: Group("finished"),
    Status.TIME_LIMIT: Group("limited", is_timed=True),
    Status.MEMORY_LIMIT: Group("limited", is_timed=True),
    Status.NODE_LIMIT: Group("limited"),
    Status.ASSIGNMENT_LIMIT: Group("limited"),
    Status.STOPPED: Group("limited"),
    Status.FAILED: Group("failed"),
    Status.UNSUPPORTED: Group("unsupported"),
    Status.UNAVAILABLE: Group("unavailable"),
    Status.NOT_RUN: Group(NOT_NEEDED),
}
OUTCOMES = tuple(dict.fromkeys(group.outcome for group in GROUPS.values()))
STARTED = OUTCOMES[: OUTCOMES.index("failed") + 1]
ENDED = STARTED[:-1]  # with a result: finished or at a limit
TIMED = tuple(status.value for status, group in GROUPS.items() if group.is_timed)


def outcome(status: str) -> str:
    """Return the outcome that a status counts as."""
    with suppress(ValueError):
        return GROUPS[Status(status)].outcome
    raise UserError(f"status {status!r} of a run has no outcome; solve the run again")


def stated(status: str, bound_ratio: float | None) -> str:
    """Return the status of a run in the tables: an optimum needs a lower bound above 0 or an exact fit.

    The stopping rule of some methods allows an absolute gap, which can exceed the whole objective.
    """
    is_vacuous = status == Status.OPTIMAL and bound_ratio is not None and bound_ratio <= 0.0
    return Status.CONVERGED.value if is_vacuous else status


def attempted(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs that were started: neither unsupported nor unavailable."""
    return runs[runs["outcome"].isin(STARTED)]


def main_machine(runs: pd.DataFrame) -> str:
    """Return the ``machine_id`` of most attempted runs; empty without any."""
    counts = attempted(runs[["outcome", "machine_id"]])["machine_id"].value_counts()
    return str(counts.index[0]) if len(counts) else ""


def is_timed(runs: pd.DataFrame) -> pd.Series:
    """Return for each run whether its time is compared.

    It ran on the main machine, with the most common number of parallel jobs of its test.
    """
    here = runs["machine_id"] == main_machine(runs)
    if runs.loc[here, "parallel_jobs"].nunique(dropna=False) <= 1:
        return here
    numbers = attempted(runs[here]).groupby("test")["parallel_jobs"]
    usual = runs["test"].map(numbers.agg(lambda jobs: next(iter(jobs.mode()), np.nan)))
    return here & ((runs["parallel_jobs"] == usual) | usual.isna())


def comparable_times(runs: pd.DataFrame) -> pd.Series:
    """Return the seconds of the runs that `is_timed` tells; missing for others and for failed ones."""
    return runs["time_solve_s"].where(is_timed(runs) & (runs["outcome"] != "failed"))
