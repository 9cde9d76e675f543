"""Overlays before and after of the best, median and worst runs; each opens the view of its run."""

from __future__ import annotations

from typing import Any

from reports.page import Page
from reports.pairs import OWN_TEST
from reports.tables import Tables, case_names
from reports.theme import Style, number, words

ID = "gallery"
TITLE = "Overlays"
POSITION = 60


def context(page: Page) -> dict[str, Any]:
    found = cards(page.tables, page.styles)
    return {
        "cases": found,
        "groups": list(dict.fromkeys((case["model"], case["test"]) for case in found)),
        "ranks": list(dict.fromkeys(case["rank"] for case in found)),
    }


def cards(tables: Tables, styles: dict[str, Style]) -> list[dict[str, Any]]:
    """Return a card per overlay, in the order of tests and methods."""
    names = dict(zip(tables.runs["run_id"], case_names(tables.runs), strict=True))
    groups = zip(tables.runs["model"], tables.runs["test"], strict=True)
    tests = {key: i for i, key in enumerate(dict.fromkeys(groups))}
    methods = {method: i for i, method in enumerate(tables.methods)}
    ordered = sorted(
        tables.overlays,
        key=lambda item: (tests[item["model"], item["test"]], methods[item["method"]]),
    )
    return [_card(item, styles, names) for item in ordered]


def _card(item: dict[str, Any], styles: dict[str, Style], names: dict[str, str]) -> dict[str, Any]:
    name = names.get(item["run_id"], item["shape"])
    level = f"{words(item['test'])} {item['level']:g}, trial {item['trial']}"
    return {
        "run": item["run_id"],
        "method": item["method"],
        "name": styles[item["method"]].name,
        "where": name if item["test"] == OWN_TEST else f"{name}, {level}",
        "test": item["test"],
        "title": f"{item['rank']} run of {words(item['test'])}",
        "rank": item["rank"],
        "rmse": number(item.get("rmse")),
        "status": item["status"],
        "model": item["model"],
    }
