"""Overlays before and after of the best, median and worst runs, drawn in the browser."""

from __future__ import annotations

from collections import Counter
from typing import Any

from reports.page import Page, pack_json
from reports.tables import Tables

ID = "gallery"
TITLE = "Overlays"
POSITION = 60
CARDS = 12  # shown at first, as in cards.js


def context(page: Page) -> dict[str, Any]:
    found = ordered(page.tables)
    page.data["gallery"] = pack_json(
        {name: [item[name] for item in found] for name in ("run_id", "rank")}
    )
    groups = Counter((item["model"], item["test"]) for item in found)
    return {
        "count": len(found),
        "groups": list(groups),
        "places": min(CARDS, next(iter(groups.values()), 0)),  # kept free, so that nothing moves
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
