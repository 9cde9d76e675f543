"""The figures of the paper, as far as this experiment has their runs."""

from __future__ import annotations

from typing import Any

from reports.figures import paper_2d, paper_3d, paper_examples, paper_images, paper_scans
from reports.page import Page

ID = "paper"
TITLE = "The paper's figures"
FIGURES = (paper_examples, paper_2d, paper_images, paper_3d, paper_scans)


ROLES = {
    "mean": "mean",
    "median": "median",
    "band": "10–90 % band",
    "floor": "fit to the true pairs",
}


def context(page: Page) -> dict[str, Any]:
    figures = []
    for module in FIGURES:
        figure = module.build(page.tables, page.styles)
        if figure is None:
            continue
        view, content = next(iter(figure.payload["views"].items()))
        present = {trace["meta"]["role"] for trace in content["data"]}
        figures.append(
            {
                "figure": page.add_figure(figure),
                "caption": module.CAPTION,
                "roles": [
                    (name, text, name in module.DRAWN)
                    for name, text in ROLES.items()
                    if name in present
                ],
                "prints": page.add_print(figure, view, module.DRAWN, figure.id, figure.title),
            }
        )
    return {"figures": figures}
