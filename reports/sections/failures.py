"""Every run that did not finish, grouped by reason."""

from __future__ import annotations

import re
from typing import Any

import pandas as pd

from reports.page import Page
from reports.tables import reason as reason_of
from reports.theme import words
from workflows.outcomes import OUTCOMES

ID = "failures"
TITLE = "Runs that did not finish"
POSITION = 70
MAX_LISTED = 50  # runs of a row
SHOWN = ["run_id", "method", "test", "outcome", "status", "message"]
_NUMBER = re.compile(r"\d+(\.\d+)?")


def context(page: Page) -> dict[str, Any]:
    runs = page.tables.runs
    rest = runs.loc[runs["outcome"] != "finished", SHOWN]
    rest = rest.assign(reason=rest["message"].map(_without_numbers(rest["message"])))
    groups: list[dict[str, Any]] = []
    for (outcome, method, status, reason), part in rest.groupby(
        ["outcome", "method", "status", "reason"], sort=False
    ):
        tests = part.groupby("test", sort=False).size()
        message = reason if part["message"].nunique() > 1 else part["message"].iloc[0]
        groups.append(
            {
                "outcome": outcome,
                "method": method,
                "status": status,
                "reason": reason_of(
                    str(status), str(message), page.tables.cards.get(str(method), {})
                ),
                "count": len(part),
                "where": ", ".join(f"{words(str(test))} ({n})" for test, n in tests.items()),
                "runs": list(part["run_id"].iloc[:MAX_LISTED]),
                "more": max(0, len(part) - MAX_LISTED),
            }
        )
    methods = page.tables.methods
    groups.sort(key=lambda g: (OUTCOMES.index(g["outcome"]), methods.index(g["method"])))
    return {
        "groups": groups,
        "count": len(rest),
        "planned": len(runs),
    }


def _without_numbers(messages: pd.Series) -> dict[str, str]:
    """Return each message without its numbers, by which runs share a row: boxes differ in every run."""
    return {message: _NUMBER.sub("…", message) for message in messages.unique()}
