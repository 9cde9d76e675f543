"""Boxes and assignments of every stage of a search."""

from __future__ import annotations

from typing import Any

from reports.measured import boxes_per_stage
from reports.page import Page

ID = "stages"
TITLE = "Boxes per stage"
POSITION = 52


def context(page: Page) -> dict[str, Any] | None:
    shown = boxes_per_stage(page.measured)
    labels = {style.name: label for label, style in page.styles.items()}
    return {"shown": shown, "labels": labels} if shown else None
