"""Error and time versus level, interactive and in print."""

from __future__ import annotations

from typing import Any

from reports.figures import levels
from reports.page import Page

ID = "levels"
TITLE = "Error and time versus level"

_MIME = {".svg": "SVG", ".pdf": "PDF"}


def context(page: Page) -> dict[str, Any]:
    figures = []
    for model in dict.fromkeys(page.tables.runs["model"]):
        runs = levels.prepare(page.tables, model)
        if runs["rmse"].isna().all():
            continue
        figures.append(
            {
                "figure": page.add_figure(levels.build(page.tables, page.styles, model)),
                "model": model,
                "errors": {name: levels.ERRORS[name][0] for name in levels.available_errors(runs)},
                "prints": [
                    page.add_download(
                        path.name,
                        path.read_bytes(),
                        f"{statistic} over trials, {_MIME[path.suffix]}",
                    )
                    for statistic in ("median", "mean")
                    for path in levels.save_static(
                        page.tables, page.styles, model, statistic, page.folder
                    )
                ],
                "floor": bool(runs["rmse_floor"].notna().any()),
            }
        )
    return {"figures": figures}
