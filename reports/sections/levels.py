"""Error and time against level, interactive and for print."""

from __future__ import annotations

from typing import Any

from reports.figures import levels
from reports.page import Page
from reports.pairs import is_own_data

ID = "levels"
TITLE = "Error and time against level"
POSITION = 40

SUFFIX = {"median": "", "mean": "-mean"}


def context(page: Page) -> dict[str, Any] | None:
    """Return a figure per model; None for own pairs, which have a single level."""
    if is_own_data(page.tables):
        return None
    figures = []
    for model in page.tables.runs["model"].unique():
        runs = levels.prepare(page.tables, model)
        if runs["rmse"].isna().all():
            continue
        figure = page.add_figure(levels.build(page.tables, page.styles, model))
        prints = [
            download
            for statistic in ("median", "mean")
            for download in page.add_print(
                figure,
                "rmse",
                (statistic, "band", "floor"),
                f"levels-{model}{SUFFIX[statistic]}",
                f"{model}, {statistic} over trials",
            )
        ]
        figures.append(
            {
                "figure": figure,
                "model": model,
                "errors": {name: levels.ERRORS[name] for name in levels.available_errors(runs)},
                "prints": prints,
                "floor": bool(runs["rmse_floor"].notna().any()),
            }
        )
    return {"figures": figures}
