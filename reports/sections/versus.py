"""Two methods on identical instances: wins and losses, scatter, test, and where they differ."""

from __future__ import annotations

from typing import Any

from reports.figures import versus
from reports.page import Page
from reports.paired import comparisons
from reports.standing import matrices

ID = "versus"
TITLE = "Compare two"
POSITION = 35


def context(page: Page) -> dict[str, Any] | None:
    """Return the figure; None unless two methods were attempted. It opens with the best two methods."""
    found = comparisons(page.tables)
    if not found:
        return None
    cards = page.tables.cards
    start = {matrix.model: _first_two(list(matrix.rows), cards) for matrix in matrices(page.tables)}
    figure = page.add_figure(versus.build(found, [start[each["model"]] for each in found]))
    return {"figure": figure, "models": [each["model"] for each in found]}


def _first_two(ranked: list[str], cards: dict[str, Any]) -> list[str]:
    """Return the best method and the best one that is not a variant of it, if there is one."""
    best, *others = ranked
    baseline = cards.get(best, {}).get("baseline")
    return [
        best,
        next(
            (name for name in others if cards.get(name, {}).get("baseline") != baseline), others[0]
        ),
    ]
