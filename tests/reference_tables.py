"""Tables of runs and their statistics, by pandas and group by group: slow, and easy to check."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from baselines import registry
from workflows import attribution, outcomes, records
from workflows.labels import display_names
from workflows.stages.plan import Plan, plan_table


def join_runs(plan: Plan, folder: Path) -> pd.DataFrame:
    """Return one row per planned run; every run is needed."""
    metrics = pd.read_parquet(folder / plan.view / "metrics" / "metrics.parquet")
    runs = (
        plan_table(plan)
        .merge(_raw(plan, folder).drop(columns="instance_id"), on="run_id", validate="one_to_one")
        .merge(
            metrics.drop(columns=["instance_id", "n_inliers"]), on="run_id", validate="one_to_one"
        )
    )
    methods = {method.name: method for method in plan.methods}
    names = display_names(plan.experiment.methods)
    cards = {name: registry.read_card(method.baseline) for name, method in methods.items()}
    runs = runs.assign(
        schema_version=records.SCHEMA_VERSION,
        experiment=plan.experiment.name,
        display_name=runs["method"].map(names),
        provenance=runs["method"].map({name: card.provenance for name, card in cards.items()}),
        n_inliers_ratio=runs["method"].map({n: m.n_inliers_ratio for n, m in methods.items()}),
        outcome=runs["status"].map(outcomes.outcome),
    )
    return records.conform(attribution.attribute(runs), records.runs_columns(), "reference")


def join_traces(plan: Plan, folder: Path) -> pd.DataFrame:
    """Return the bound histories of all runs, in the order of the runs."""
    events = _raw(plan, folder, ".trace", records.RAW_TRACES)
    events = events.merge(
        plan_table(plan)[["run_id", "method"]], on="run_id", validate="many_to_one"
    )
    return records.conform(events, records.TRACES, "reference")


def _raw(plan: Plan, folder: Path, suffix: str = "", columns: dict = records.RAW) -> pd.DataFrame:
    paths = [folder / f"runs/{m.name}/{chunk.name}{suffix}.parquet" for m, chunk in plan.jobs()]
    return pd.concat([records.read(path, columns) for path in paths], ignore_index=True)


def level_statistics(runs: pd.DataFrame, column: str, minimum: float) -> dict[tuple, dict]:
    """Return the statistics of a column by test, row, method and level; values are at least `minimum`."""
    found = {}
    for key, part in runs.groupby(["test", "row", "method", "level"]):
        known = part[part[column].notna()].sort_values(column, kind="stable")
        if known.empty:
            continue
        values, run_ids = known[column].to_numpy(), known["run_id"].to_numpy()
        drawn = np.maximum(values, minimum)
        found[key] = {
            "planned": len(part),
            "failed": int((part["outcome"] == "failed").sum()),
            "any_limited": int((part["outcome"] == "limited").sum()),
            "limited": int((known["outcome"] == "limited").sum()),
            "count": len(known),
            "low": np.quantile(drawn, 0.1),
            "median": np.median(drawn),
            "high": np.quantile(drawn, 0.9),
            "mean": drawn.mean(),
            "shown_low": np.quantile(values, 0.1),
            "shown_median": np.median(values),
            "shown_high": np.quantile(values, 0.9),
            "shown_mean": values.mean(),
            "worst": values[-1],
            "median_run": run_ids[(len(values) - 1) // 2],
            "worst_run": run_ids[-1],
        }
    return found
