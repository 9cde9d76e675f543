"""The parameters of every method, with the default of those that the experiment changed."""

from __future__ import annotations

from typing import Any

import pandas as pd
import yaml

from reports.page import Page
from reports.tables import limits_of

ID = "parameters"
TITLE = "Parameters"
POSITION = 90


_ORIGINS = {
    "paper": "rule of its paper",
    "code": "rule of its authors' code",
    "textbook": "rule of a textbook",
    "ours": "our rule",
}


def context(page: Page) -> dict[str, Any]:
    runs = page.tables.runs
    return {
        "methods": [
            (name, parameters(page.tables.cards.get(name, {}))) for name in page.tables.methods
        ],
        "rules": {
            name: f"{_ORIGINS[rule['origin']]}: {rule['text']}"
            for name in page.tables.methods
            if (card := page.tables.cards.get(name, {})).get("options", {}).get("threshold")
            == "paper"
            and (rule := card.get("threshold_rule"))
        },
        "bounds": bounds(runs),
    }


def bounds(runs: pd.DataFrame) -> list[tuple[Any, ...]]:
    """Return minimum, median and maximum of the noise bounds given, per model, test and level."""
    once = runs.drop_duplicates("instance_id").groupby(["model", "test", "level"], sort=False)
    return [(*key, *part.quantile([0, 0.5, 1])) for key, part in once["noise_bound"]]


def parameters(card: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return name, value and, if it differs, the default; limits and n_inliers first.

    Parameters without effect are excluded.
    """
    defaults, options = card.get("parameters", {}), card.get("options", {})
    rows = [
        ("limits", ", ".join(limits_of(card).values()) or "not stated", ""),
        (
            "n_inliers",
            f"{card.get('n_inliers_ratio', 1):g} × the true pairs, or × the pairs that the dataset "
            "prescribes",
            "",
        ),
    ]
    for name, default in {**options, **defaults}.items():
        if name in card.get("idle_options", ()):
            continue
        value = options.get(name, default)
        rows.append((name, _plain(value), "" if value == default else _plain(default)))
    return rows


def _plain(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip()
