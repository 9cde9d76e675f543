"""Every run that did not finish, grouped by reason."""

from __future__ import annotations

from typing import Any

from reports.page import Page
from reports.tables import limits_of
from reports.theme import words
from workflows.outcomes import OUTCOMES

ID = "failures"
TITLE = "Runs that did not finish"
POSITION = 70


def context(page: Page) -> dict[str, Any]:
    runs = page.tables.runs
    rest = runs[runs["outcome"] != "finished"]
    groups: list[dict[str, Any]] = []
    for (outcome, method, status, message), part in rest.groupby(
        ["outcome", "method", "status", "message"], sort=False
    ):
        tests = part.groupby("test", sort=False).size()
        groups.append(
            {
                "outcome": outcome,
                "method": method,
                "status": status,
                "reason": _reason(
                    str(status), str(message), page.tables.cards.get(str(method), {})
                ),
                "count": len(part),
                "where": ", ".join(f"{words(str(test))} ({n})" for test, n in tests.items()),
                "runs": list(part["run_id"]),
            }
        )
    groups.sort(
        key=lambda g: (OUTCOMES.index(g["outcome"]), page.tables.methods.index(g["method"]))
    )
    return {
        "groups": groups,
        "count": len(rest),
        "planned": len(runs),
        "replay": page.tables.provenance.get("replay", ""),
    }


def _reason(status: str, message: str, card: dict[str, Any]) -> str:
    """Return why runs did not finish: the limit that they hit, or their message."""
    if limit := limits_of(card).get(status):
        return f"hit its limit of {limit}" + (f" ({message})" if message else "")
    return message or "no reason given"
