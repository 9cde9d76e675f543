"""Accounting, a row per method and test, and the distributions of error and time."""

from __future__ import annotations

from typing import Any

import pandas as pd

from reports.figures import profile
from reports.page import Page
from reports.sections.outcome import success_rule
from reports.tables import Tables, count_outcomes, share_interval
from workflows.outcomes import NOT_NEEDED, OUTCOMES, STARTED, attempted
from workflows.summary import summarise

ID = "overview"
TITLE = "Accounting"
POSITION = 30


def context(page: Page) -> dict[str, Any]:
    counts = count_outcomes(page.tables.runs).loc[page.tables.methods]
    models = list(page.tables.runs["model"].unique())
    is_idle = counts[list(STARTED)].sum(axis=1) == 0
    solved = attempted(page.tables.runs)["model"]
    return {
        "outcomes": [name for name in OUTCOMES if name != NOT_NEEDED or counts[name].any()],
        "accounting": list(counts[~is_idle].iterrows()),
        "idle": list(counts[is_idle].iterrows()),
        "total": counts.sum(),
        "summary": summary(page.tables),
        "models": models,
        "tests": list(page.tables.runs["test"].unique()),
        "target": success_rule(page.tables.runs),
        "profiles": [
            page.add_figure(profile.build(page.tables, page.styles, model))
            for model in models
            if (solved == model).any()
        ],
    }


def summary(tables: Tables) -> list[dict[str, Any]]:
    """Return a row per model, test and method, including runs that could not be attempted."""
    keys = ["model", "test", "method"]
    planned = tables.runs.groupby(keys, sort=False)["outcome"].agg(_outcomes).reset_index()
    floors = tables.runs.groupby(keys, sort=False)["rmse_floor"].median()
    sizes = tables.runs.groupby(keys, sort=False).size()
    done = summarise(tables.runs).set_index(keys)
    rows: list[dict[str, Any]] = []
    for row in planned.to_dict("records"):
        key = tuple(row[name] for name in keys)
        result = done.loc[key] if key in done.index else None
        rows.append(
            {
                **{str(name): value for name, value in row.items()},
                "planned": int(sizes[key]),
                "floor": float(floors[key]),
                "complete": row["outcome"] == f"{sizes[key]} finished",
                "result": result,
                "interval": _success_interval(result),
            }
        )
    # a block of methods per test
    groups = list(dict.fromkeys((row["model"], row["test"]) for row in rows))
    return sorted(rows, key=lambda row: groups.index((row["model"], row["test"])))


def _success_interval(result: pd.Series | None) -> tuple[float, float] | None:
    """Return Wilson's interval of the success rate of the attempted runs."""
    if result is None:
        return None
    return share_interval(round(result["success"] * result["runs"]), int(result["runs"]))


def _outcomes(outcomes: pd.Series) -> str:
    counts = outcomes.value_counts()
    return ", ".join(f"{counts[name]} {name}" for name in OUTCOMES if name in counts)
