"""Boxes and assignments of every stage of a search."""

from __future__ import annotations

import dataclasses
from typing import Any

from reports.measured import boxes_per_stage
from reports.page import Page

ID = "stages"
TITLE = "Boxes per stage"
POSITION = 52


def context(page: Page) -> dict[str, Any] | None:
    runs = page.measured.runs
    names = {label: style.name for label, style in page.styles.items()}
    # display names in older tables may be the same for several methods; those of styles differ
    named = runs.assign(display_name=runs["method"].map(names))
    shown = boxes_per_stage(dataclasses.replace(page.measured, runs=named))
    labels = {name: label for label, name in names.items()}
    return {"shown": shown, "labels": labels} if shown else None
