"""Write the folder of tables from which the report is built."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from baselines import registry
from dcreg.files import whole_file
from dcreg.status import Status
from workflows import attribution, outcomes, provenance, records
from workflows.config import MethodSettings
from workflows.instances import read_problems
from workflows.metrics import METRICS
from workflows.outcomes import OUTCOMES
from workflows.stages.plan import Plan, plan_table

MAX_OVERLAY_POINTS = 400  # per set
# Facts about an instance in the row of a run.
OF_INSTANCE = [
    "instance_digest", "n_source", "n_target", "seed", "dim", "n_inliers_true", "noise_bound",
    "T_reference",
]  # fmt: skip


def aggregate(plan: Plan, folder: Path) -> None:
    """Join plan, raw results and metrics, and write the folder ``tables/`` of the plan."""
    out = folder / plan.view / "tables"
    runs = join_runs(plan, folder)
    records.write(runs, out / "runs.parquet", csv=True)
    records.write(join_traces(plan, folder, runs), out / "traces.parquet", csv=True)
    with whole_file(out / "accounting.csv") as part:
        accounting(runs).to_csv(part, index=False)
    _write_json(out / "provenance.json", _provenance(plan, runs))
    _write_json(out / "overlays.json", overlays(plan, folder, runs))


def join_runs(plan: Plan, folder: Path) -> pd.DataFrame:
    """Return exactly one row per planned run, in the documented columns."""
    planned = plan_table(plan)
    raw = _raw(plan, folder, "", records.RAW)
    metrics = pd.read_parquet(folder / plan.view / "metrics" / "metrics.parquet")
    runs = planned.merge(
        raw.drop(columns="instance_id"), on="run_id", how="left", validate="one_to_one"
    ).merge(
        metrics.drop(columns=["instance_id", "n_inliers"]),
        on="run_id",
        how="left",
        validate="one_to_one",
    )
    without = runs.loc[runs["status"].isna() | runs["dim"].isna(), "method"]
    if len(without):
        raise records.SchemaError(
            f"{folder}: {len(without)} planned runs of {without.iloc[0]} have no result; "
            "run the experiment again"
        )
    left_out = _left_out(plan, runs)
    runs = pd.concat([runs, left_out], ignore_index=True) if len(left_out) else runs
    by_name = {method.name: method for method in plan.methods}
    cards = {name: registry.read_card(method.baseline) for name, method in by_name.items()}
    runs = runs.assign(
        schema_version=records.SCHEMA_VERSION,
        experiment=plan.experiment.name,
        display_name=runs["method"].map(lambda name: display_name(by_name[name])),
        provenance=runs["method"].map(lambda name: cards[name].provenance),
        n_inliers_ratio=runs["method"].map(lambda name: by_name[name].n_inliers_ratio),
        outcome=runs["status"].map(outcomes.outcome),
    )
    runs = attribution.attribute(runs)
    return records.conform(runs, records.runs_columns(), "tables/runs.parquet")


def _left_out(plan: Plan, runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each planned run that is not needed, with the facts about its instance."""
    facts = runs.drop_duplicates("instance_id").set_index("instance_id")[OF_INSTANCE]
    answers = {name: False for name, metric in METRICS.items() if metric.unit == "yes/no"}
    left_out = plan_table(plan, plan.left_out()).join(facts, on="instance_id")
    return left_out.assign(status=Status.NOT_RUN.value, n_inliers=0, **answers)


def display_name(method: MethodSettings) -> str:
    """Return the displayed name of a line: its label, or the card's name with an unusual n_inliers.

    A reconstruction is always marked as such.
    """
    card = registry.read_card(method.baseline)
    if method.label:
        is_unmarked = (
            card.provenance == "reconstruction" and "reconstruct" not in method.label.lower()
        )
        return f"{method.label} (reconstructed)" if is_unmarked else method.label
    name = card.display_name
    return name if method.n_inliers_ratio == 1 else f"{name} (n_p × {method.n_inliers_ratio:g})"


def join_traces(plan: Plan, folder: Path, runs: pd.DataFrame) -> pd.DataFrame:
    """Return the bound histories of all runs, in the order of the runs."""
    traces = _raw(plan, folder, ".trace", records.RAW_TRACES)
    traces = traces.merge(runs[["run_id", "method"]], on="run_id", validate="many_to_one")
    return records.conform(traces, records.TRACES, "traces")


def accounting(runs: pd.DataFrame) -> pd.DataFrame:
    """Count planned runs and their outcomes per method, and check that they add up."""
    counts = pd.crosstab(runs["method"], runs["outcome"])
    counts = counts.reindex(runs["method"].unique())
    counts = counts.reindex(columns=list(OUTCOMES), fill_value=0)
    counts.insert(0, "planned", runs.groupby("method").size().reindex(counts.index))
    if not (counts["planned"] == counts[list(OUTCOMES)].sum(axis=1)).all():
        raise AssertionError(f"planned = {' + '.join(OUTCOMES)}")
    return counts.rename_axis("method").reset_index()


def overlays(plan: Plan, folder: Path, runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return points and pose of the best, median and worst run of every method and test."""
    problems = {
        problem.instance_id: problem
        for chunk in plan.chunks
        for problem in read_problems(folder / f"instances/{chunk.name}.npz")
    }
    posed = runs[runs["rmse"].notna()]
    entries = []
    for _, group in posed.groupby(["method", "test", "model"], sort=False):
        ranked = group.sort_values("rmse", kind="stable")
        for rank, position in _picks(len(ranked)).items():
            run = ranked.iloc[position]
            problem = problems[run["instance_id"]]
            entries.append(
                {
                    **{key: run[key] for key in ("run_id", "method", "dataset", "shape", "test")},
                    **{key: run[key].item() for key in ("level", "trial", "rmse")},
                    **{key: run[key] for key in ("status", "model")},
                    "rank": rank,
                    "source": _points(problem.source),
                    "target": _points(problem.target),
                    "T_target_source": json.loads(run["T_target_source"]),
                    "replay": replay_command(plan, run["run_id"]),
                }
            )
    return entries


def _picks(count: int) -> dict[str, int]:
    """Return the positions of the shown runs among `count` ranked ones, without repetition."""
    if count < 3:
        return {"only": 0} if count == 1 else {"best": 0, "worst": 1}
    return {"best": 0, "median": (count - 1) // 2, "worst": count - 1}


def run_command(plan: Plan) -> str:
    """Return the command line that makes these tables."""
    parts = [
        f"--{axis} {shlex.quote(','.join(map(str, values)))}"
        for axis, values in plan.selection
        if values
    ]
    return " ".join(["python -m workflows run", shlex.quote(plan.config), *parts])


def replay_command(plan: Plan, run_id: str) -> str:
    """Return the command line that repeats this run."""
    return f"{replay_of(plan)} {run_id}"


def replay_of(plan: Plan) -> str:
    """Return the command line that repeats a run, without the run."""
    return f"python -m workflows replay --experiment {shlex.quote(plan.config)}"


def _points(points: np.ndarray) -> list[list[float]]:
    """Round points to four digits of the extent of the set; keep evenly spaced ones of many."""
    step = -(-len(points) // MAX_OVERLAY_POINTS)
    digits = 4 - int(np.floor(np.log10(max(np.ptp(points, axis=0).max(), 1e-12))))
    return np.round(points[::step], max(0, digits)).tolist()


def _raw(plan: Plan, folder: Path, suffix: str, columns: dict[str, records.Column]) -> pd.DataFrame:
    tables = [
        records.read(folder / f"runs/{method.name}/{chunk.name}{suffix}.parquet", columns)
        for method, chunk in plan.jobs()
    ]
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else tables[0]


def _provenance(plan: Plan, runs: pd.DataFrame) -> dict[str, Any]:
    chosen = {axis: value for axis, value in plan.selection.model_dump().items() if value}
    reasons = runs[runs["outcome"] == "unavailable"].groupby("method")["message"].first()
    return {
        "schema_version": records.SCHEMA_VERSION,
        "experiment": plan.experiment.name,
        "config": plan.experiment.model_dump(),
        "selection": chosen,
        "machine": provenance.machine_card(),
        "machines_of_runs": sorted(runs["machine_id"].unique()),
        "versions": provenance.versions(),
        "git": provenance.git_state(),
        "created": provenance.now(),
        "commands": [run_command(plan)],
        "replay": replay_of(plan),
        "methods": {
            method.name: {
                **registry.read_card(method.baseline).model_dump(),
                "baseline": method.baseline,
                "display_name": display_name(method),
                "options": method.options,
                "idle_options": sorted(registry.idle_options(method.baseline, method.options)),
                "n_inliers_ratio": method.n_inliers_ratio,
                "limits": plan.experiment.limits_of(method).model_dump(),
                "unavailable": reasons.get(method.name, ""),
            }
            for method in plan.methods
        },
    }


def _write_json(path: Path, content: Any) -> None:
    with whole_file(path) as part:
        part.write_text(json.dumps(content, indent=1), encoding="utf-8")
