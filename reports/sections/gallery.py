"""Overlays before and after of the best, median and worst runs, with replay commands."""

from __future__ import annotations

from typing import Any

from reports.figures import overlays
from reports.page import Page

ID = "gallery"
TITLE = "Overlays"
POSITION = 60


def context(page: Page) -> dict[str, Any]:
    figure = overlays.build(page.tables, page.styles)
    if figure is None:
        return {"figure": None, "cases": []}
    page.add_figure(figure)
    cases = figure.payload["cases"]
    groups = dict.fromkeys((case["model"], case["test"]) for case in cases)
    return {
        "figure": figure,
        "cases": cases,
        "groups": list(groups),
        "ranks": list(dict.fromkeys(case["rank"] for case in cases)),
    }
