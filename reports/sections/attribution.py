"""Search and model errors, by objective regret with certified intervals."""

from __future__ import annotations

from typing import Any

from reports.figures import attribution
from reports.page import Page
from workflows.attribution import VERDICTS

ID = "attribution"
TITLE = "Attribution of errors"
POSITION = 80


def context(page: Page) -> dict[str, Any]:
    runs, methods = attribution.judged(page.tables.runs), page.tables.methods
    if runs["objective"].isna().all():
        return {"figure": None}
    bounded = runs["optimum_at_least"].notna()
    return {
        "figure": page.add_figure(attribution.build(runs, page.styles)),
        "every": attribution.drawn_share(runs),
        "verdicts": VERDICTS,
        "found": [name for name in VERDICTS if runs["verdict"].eq(name).any()],
        "counts": list(attribution.count(runs, methods).iterrows()),
        "by_test": [
            (model, test, list(counts.iterrows()))
            for model, test, counts in attribution.count_by_test(runs, methods)
        ],
        "certified": runs.loc[bounded].groupby(["instance_id", "n_inliers"]).ngroups,
        "problems": runs.groupby(["instance_id", "n_inliers"]).ngroups,
    }
