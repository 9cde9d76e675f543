"""Write the folder of tables from which the report is built."""

from __future__ import annotations

import json
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from baselines import registry
from dcreg.status import Status
from workflows import CHECKOUT, attribution, outcomes, provenance, records
from workflows.installed import why_not_here
from workflows.instances import read_problems
from workflows.integrity import sealed_file
from workflows.labels import display_names
from workflows.metrics import METRICS
from workflows.outcomes import NOT_NEEDED, OUTCOMES
from workflows.stages.clouds import CLOUDS, clouds
from workflows.stages.plan import Plan, plan_table

if TYPE_CHECKING:
    import polars as pl

MAX_OVERLAY_POINTS = 400  # per set
REPLAY = "make replay"  # of the Makefile
MOST_CSV_ROWS = 200_000  # of a CSV copy
# Facts about an instance in the row of a run.
OF_INSTANCE = [
    "instance_digest", "n_source", "n_target", "seed", "dim", "n_inliers_true", "noise_bound",
    "T_reference",
]  # fmt: skip

# Columns of runs that `attribution.attribute` and the checks need.
JUDGED = [
    "run_id", "instance_id", "method", "status", "outcome", "n_inliers", "dim", "lower_bound", "gap_tol",
    "certificate_scope", "objective", "objective_best", "objective_true", "rmse", "success", "admissible",
]  # fmt: skip
# Columns of runs that the smaller tables are made from.
SHOWN = [
    "run_id", "instance_id", "method", "dataset", "shape", "test", "level", "trial", "model", "status",
    "outcome", "message", "rmse", "machine_id",
]  # fmt: skip


def aggregate(plan: Plan, folder: Path) -> None:
    """Join plan, raw results and metrics, and write the folder ``tables/`` of the plan.

    The wide tables stream through Polars, from one file to another.
    """
    out = folder / plan.view / "tables"
    out.mkdir(parents=True, exist_ok=True)
    write(join_runs(plan, folder), out / "runs.parquet")
    write(join_traces(plan, folder), out / "traces.parquet")
    runs = pd.read_parquet(out / "runs.parquet", columns=SHOWN)
    with sealed_file(out / "accounting.csv") as part:
        accounting(runs).to_csv(part, index=False)
    _write_json(out / "provenance.json", _provenance(plan, runs), indent=1)
    _write_json(out / "overlays.json", overlays(plan, folder, runs))
    records.write(clouds(plan, folder), out / CLOUDS)


def join_runs(plan: Plan, folder: Path) -> pl.LazyFrame:
    """Return exactly one row per planned run, in the documented columns and the order of the plan.

    Raises
    ------
    SchemaError
    """
    import polars as pl

    planned = records.scan([folder / plan.view / "plan" / "plan.parquet"], list(records.PLAN))
    raw = records.scan(_files(plan, folder), list(records.RAW)).drop("instance_id")
    metrics = records.scan([folder / plan.view / "metrics" / "metrics.parquet"])
    # files of earlier versions: `outcomes.stated`
    is_vacuous = (pl.col("status") == Status.OPTIMAL.value) & (pl.col("bound_ratio") <= 0.0)
    stated = pl.when(is_vacuous).then(pl.lit(Status.CONVERGED.value)).otherwise(pl.col("status"))
    raw = raw.with_columns(status=stated)
    runs = _joined(_joined(planned, raw), metrics.drop("instance_id", "n_inliers"))
    if plan.needs is not None:
        runs = pl.concat([runs, _left_out(plan, runs)], how="diagonal_relaxed")
    runs = _joined(runs, _facts(plan), on="method").with_columns(
        schema_version=pl.lit(records.SCHEMA_VERSION),
        experiment=pl.lit(plan.experiment.name),
        outcome=pl.col("status").replace_strict(
            {status.value: group.outcome for status, group in outcomes.GROUPS.items()},
            default=None,
            return_dtype=pl.String,
        ),
    )
    judged = runs.select(JUDGED).collect(engine="streaming").to_pandas()
    _check_complete(judged, folder)
    verdicts = attribution.attribute(judged)[["run_id", *attribution.COLUMNS]]
    runs = _joined(runs, pl.from_pandas(verdicts).lazy())
    return records.conform_lazy(runs, records.runs_columns())


def join_traces(plan: Plan, folder: Path) -> pl.LazyFrame:
    """Return the bound histories of all runs, in the order of the runs.

    Raises
    ------
    SchemaError
    """
    events = records.scan(_files(plan, folder, ".trace"), list(records.RAW_TRACES))
    # a file may also have runs of an earlier plan
    own = records.scan([folder / plan.view / "plan" / "plan.parquet"], ["run_id", "method"])
    events = events.join(own, on="run_id", how="inner", maintain_order="left")
    return records.conform_lazy(events, records.TRACES)


def write(table: pl.LazyFrame, path: Path) -> None:
    """Write ``path`` as Parquet and, unless it has more than `MOST_CSV_ROWS`, its CSV copy."""
    import polars as pl

    with sealed_file(path) as part:
        table.sink_parquet(part, compression_level=1)  # a higher one saves little space
    copy, written = path.with_suffix(".csv"), pl.scan_parquet(path)
    if written.select(pl.len()).collect().item() > MOST_CSV_ROWS:
        copy.unlink(missing_ok=True)
        return
    with sealed_file(copy) as part:
        written.sink_csv(part)


def _files(plan: Plan, folder: Path, suffix: str = "") -> list[Path]:
    """Return the files of all solve jobs."""
    return [
        folder / f"runs/{method.name}/{chunk.name}{suffix}.parquet" for method, chunk in plan.jobs()
    ]


def _joined(one: pl.LazyFrame, other: pl.LazyFrame, on: str = "run_id") -> pl.LazyFrame:
    return one.join(other, on=on, how="left", maintain_order="left")


def _facts(plan: Plan) -> pl.LazyFrame:
    """Return a row per method with what its runs have in common."""
    import polars as pl

    names = display_names(plan.experiment.methods)
    rows = [
        {
            "method": method.name,
            "display_name": names[method.name],
            "provenance": registry.read_card(method.baseline).provenance,
            "n_inliers_ratio": method.n_inliers_ratio,
        }
        for method in plan.methods
    ]
    return pl.LazyFrame(rows)


def _check_complete(runs: pd.DataFrame, folder: Path) -> None:
    """Refuse planned runs with no or with several results, and statuses without an outcome."""
    without = runs.loc[runs["status"].isna() | runs["dim"].isna(), "method"]
    if len(without):
        raise records.SchemaError(
            f"{folder}: {len(without)} planned runs of {without.iloc[0]} have no result; "
            "run the experiment again"
        )
    if twice := int(runs["run_id"].duplicated().sum()):
        raise records.SchemaError(
            f"{folder}: {twice} runs have several results; {records.RUN_AGAIN}"
        )
    for status in runs.loc[runs["outcome"].isna(), "status"]:
        outcomes.outcome(status)


def _left_out(plan: Plan, runs: pl.LazyFrame) -> pl.LazyFrame:
    """Return a row for each planned run that is not needed, with the facts about its instance."""
    import polars as pl

    known = runs.select("instance_id", *OF_INSTANCE)
    facts = known.unique("instance_id", keep="first", maintain_order=True).collect().to_pandas()
    answers = {name: False for name, metric in METRICS.items() if metric.unit == "yes/no"}
    left_out = plan_table(plan, plan.left_out()).join(
        facts.set_index("instance_id"), on="instance_id"
    )
    table = left_out.assign(status=Status.NOT_RUN.value, n_inliers=0, **answers)
    return pl.from_pandas(table).lazy()


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
    posed = runs[runs["rmse"].notna()].sort_values("rmse", kind="stable")
    places, ranks = [], []
    groups = posed.groupby(["method", "test", "model"], sort=False).indices.values()
    for rows in sorted(groups, key=lambda rows: posed.index[rows].min()):  # as in the plan
        for rank, position in _picks(len(rows)).items():
            places.append(rows[position])
            ranks.append(rank)
    if not places:
        return []
    chosen = posed.iloc[places].assign(rank=ranks)
    instances = set(chosen["instance_id"])
    clouds = {
        problem.instance_id: {"source": _points(problem.source), "target": _points(problem.target)}
        for chunk in plan.chunks
        if any(spec.instance_id in instances for spec in chunk.instances)
        for problem in read_problems(folder / f"instances/{chunk.name}.npz")
        if problem.instance_id in instances
    }
    poses = pd.read_parquet(
        folder / plan.view / "tables" / "runs.parquet", columns=["run_id", "T_target_source"],
        filters=[("run_id", "in", list(chosen["run_id"]))],
    ).set_index("run_id")["T_target_source"]  # fmt: skip
    return [
        {
            **{key: run[key] for key in ("run_id", "method", "dataset", "shape", "test")},
            **{key: run[key] for key in ("level", "trial", "rmse", "status", "model", "rank")},
            **clouds[run["instance_id"]],
            "T_target_source": json.loads(poses[run["run_id"]]),
        }
        for run in chosen.to_dict("records")
    ]


def _picks(count: int) -> dict[str, int]:
    """Return the positions of the shown runs among `count` ranked ones, without repetition."""
    if count < 3:
        return {"only": 0} if count == 1 else {"best": 0, "worst": 1}
    return {"best": 0, "median": (count - 1) // 2, "worst": count - 1}


def run_command(plan: Plan) -> str:
    """Return the command line that makes these tables; of blocks, that of the campaign."""
    if plan.needs is not None:
        return f"python -m reports evidence --experiments {shlex.quote(plan.config)}"
    parts = [
        f"--{axis} {shlex.quote(','.join(map(str, values)))}"
        for axis, values in plan.selection
        if values
    ]
    return " ".join(["python -m workflows run", shlex.quote(plan.config), *parts])


def replay_of() -> str:
    """Return the command line that repeats a run of this folder of results, without the run."""
    here = Path.cwd()
    if here == CHECKOUT:
        return f"{REPLAY} RUN="
    return f"{REPLAY} RESULTS={shlex.quote(os.path.relpath(here / 'results', CHECKOUT))} RUN="


def _points(points: np.ndarray) -> list[list[float]]:
    """Round points to four digits of the extent of the set; keep evenly spaced ones of many."""
    step = -(-len(points) // MAX_OVERLAY_POINTS)
    digits = 4 - int(np.floor(np.log10(max(np.ptp(points, axis=0).max(), 1e-12))))
    return np.round(points[::step], max(0, digits)).tolist()


def _provenance(plan: Plan, runs: pd.DataFrame) -> dict[str, Any]:
    chosen = {axis: value for axis, value in plan.selection.model_dump().items() if value}
    reasons = runs[runs["outcome"] == "unavailable"].groupby("method")["message"].first().to_dict()
    needed = set(runs.loc[runs["outcome"] != NOT_NEEDED, "method"])
    reasons |= {
        method.name: why_not_here(method) for method in plan.methods if method.name not in needed
    }
    names = display_names(plan.experiment.methods)
    return {
        "schema_version": records.SCHEMA_VERSION,
        "experiment": plan.experiment.name,
        "config": plan.experiment.model_dump(),
        # a config of the user: relative to the checkout
        "config_file": os.path.relpath(plan.config, CHECKOUT)
        if Path(plan.config).is_file()
        else "",
        "selection": chosen,
        "machines_of_runs": sorted(runs["machine_id"].unique()),
        **provenance.origin(),
        "commands": [run_command(plan)],
        "replay": replay_of(),
        "methods": {
            method.name: {
                **registry.read_card(method.baseline).model_dump(),
                "baseline": method.baseline,
                "origin": registry.origin_of(method.baseline),
                "display_name": names[method.name],
                "options": method.options,
                "idle_options": sorted(registry.idle_options(method.baseline, method.options)),
                "n_inliers_ratio": method.n_inliers_ratio,
                "limits": plan.experiment.limits_of(method).model_dump(),
                "unavailable": reasons.get(method.name, ""),
            }
            for method in plan.methods
        },
    }


def _write_json(path: Path, content: Any, indent: int | None = None) -> None:
    """Write JSON; an indent takes several times as long."""
    with sealed_file(path) as part:
        part.write_text(json.dumps(content, indent=indent), encoding="utf-8")
