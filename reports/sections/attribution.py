"""Search error or model error, by objective regret."""

from __future__ import annotations

from typing import Any

from reports.figures import attribution
from reports.page import Page

ID = "attribution"
TITLE = "Objective regret"


def context(page: Page) -> dict[str, Any]:
    judged = attribution.judge(page.tables.runs)
    if judged.empty:
        return {"figure": None}
    counts = attribution.count(judged, page.tables.methods)
    return {
        "figure": page.add_figure(attribution.build(page.tables, page.styles, judged)),
        "verdicts": attribution.VERDICTS,
        "counts": [(method, row) for method, row in counts.iterrows()],
        "certified": int(judged.loc[judged["certified"], "instance_id"].nunique()),
        "instances": int(judged["instance_id"].nunique()),
    }
