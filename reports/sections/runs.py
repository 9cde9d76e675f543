"""All runs in one table, the wrong runs of each method, and a view of each run, made in the browser."""

from __future__ import annotations

from typing import Any

from reports.page import Page, pack_json
from reports.runs.details import Details
from reports.runs.listed import ANSWERS, NO_POSE, NOT_RUN, WRONG, columns, listed

ID = "runs"
TITLE = "Runs"
POSITION = 56


def context(page: Page) -> dict[str, Any]:
    tables = page.tables
    runs = listed(tables)
    details = Details(tables, runs)
    for number, content in details.chunks():
        page.data[f"runs-{number}"] = pack_json(content)
    found = columns(runs, list(page.styles), details.chunk_of)
    page.data["runs"] = pack_json(
        {
            **found,
            "names": [style.name for style in page.styles.values()],
            "replay": tables.replay_command,
        }
    )
    started = runs[runs["answer"] != NOT_RUN]
    wrong = started[started["answer"].isin([WRONG, NO_POSE])].groupby("method").size()
    return {
        "count": len(runs),
        "total": len(tables.runs),
        "started": len(started),
        "tests": list(runs["test"].unique()),
        "statuses": list(runs["status"].unique()),
        "answers": ANSWERS,
        "models": list(runs["model"].unique()),
        "methods": page.styles,
        "wrong": {name: int(wrong[name]) for name in page.styles if name in wrong.index},
    }
