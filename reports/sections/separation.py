"""Bound against search: each bound in the search of its method, and in ours."""

from __future__ import annotations

from typing import Any

from reports.measured import effects, separation, words_of
from reports.page import Page

ID = "separation"
TITLE = "Bound and search"
POSITION = 54


def context(page: Page) -> dict[str, Any] | None:
    """Return the tables of each model; None if no bound runs in two searches."""
    measured = page.measured
    models = [
        (words_of(model), shown, effects(measured, model))
        for model in measured.runs["model"].unique()
        if (shown := separation(measured, model))
    ]
    return {"models": models} if models else None
