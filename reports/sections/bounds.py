"""Bound and gap histories of every certifying method."""

from __future__ import annotations

from typing import Any

from reports.figures import bounds
from reports.page import Page

ID = "bounds"
TITLE = "Bounds and gaps"
POSITION = 50


def context(page: Page) -> dict[str, Any]:
    figure = bounds.build(page.tables, page.styles)
    if figure is None:
        return {"figure": None}
    page.add_figure(figure)
    return {
        "figure": figure,
        "shown": len(figure.payload["instances"]),
        "total": figure.payload["total"],
    }
