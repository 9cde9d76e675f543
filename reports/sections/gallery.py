"""Overlays before and after of the best, median and worst runs, drawn in the browser."""

from __future__ import annotations

from typing import Any

from reports.page import Page, pack_json
from reports.tables import Tables

ID = "gallery"
TITLE = "Overlays"
POSITION = 60


def context(page: Page) -> dict[str, Any]:
    found = ordered(page.tables)
    page.data["gallery"] = pack_json(
        {name: [item[name] for item in found] for name in ("run_id", "rank")}
    )
    return {
        "count": len(found),
        "groups": list(dict.fromkeys((item["model"], item["test"]) for item in found)),
        "ranks": list(dict.fromkeys(item["rank"] for item in found)),
    }


def ordered(tables: Tables) -> list[dict[str, Any]]:
    """Return the overlays in the order of tests and methods."""
    groups = zip(tables.runs["model"], tables.runs["test"], strict=True)
    tests = {key: i for i, key in enumerate(dict.fromkeys(groups))}
    methods = {method: i for i, method in enumerate(tables.methods)}
    return sorted(
        tables.overlays,
        key=lambda item: (tests[item["model"], item["test"]], methods[item["method"]]),
    )
