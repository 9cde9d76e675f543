"""The standalone figures that this experiment has runs for."""

from __future__ import annotations

from typing import Any

from reports.figures import standalone
from reports.page import Page
from workflows.discovery import modules

ID = "figures"
TITLE = "Figures"
POSITION = 20

ROLES = {
    "mean": "mean",
    "median": "median",
    "band": "10–90 % band",
    "floor": "fit to the true pairs",
}


def context(page: Page) -> dict[str, Any] | None:
    """Return the figures; None if the experiment has no runs for any."""
    figures = []
    for module in sorted(modules(standalone), key=lambda module: module.POSITION):
        if hasattr(module, "PAPER") and not module.PAPER.experiment:
            continue  # a drawing of the method: the same for every experiment
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
    return {"figures": figures} if figures else None
