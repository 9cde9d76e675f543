"""The summary after a run, the table of a plan, and the list of methods."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from baselines import registry
from data.registry import GROUP as DATASETS
from dcreg.plugins import plugins
from dcreg.status import Status
from dcreg.text import percent
from workflows import records
from workflows.archives import archived
from workflows.compose import QUICK, ConfigError
from workflows.config import Experiment, MethodSettings, load
from workflows.metrics import BROKEN, METRICS
from workflows.metrics import GROUP as ADDED_METRICS
from workflows.outcomes import attempted, comparable_times
from workflows.stages.plan import Plan, PlannedRun, expand, size_notes
from workflows.stages.solve import journalled

SUMMARISED = [
    "run_id", "model", "test", "method", "display_name", "status", "outcome", "rmse", "success", "gap",
    "bound_ratio",
]  # fmt: skip


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Summarise the attempted runs per method and test.

    A run without a pose counts with the worst RMSE and as no success; otherwise a method would look
    better the more often it fails. Times are those of one machine; a run that failed has none.
    """
    times = comparable_times(runs).where(runs["outcome"] != "failed")
    tried = attempted(runs[SUMMARISED].assign(time_solve_s=times))
    tried = tried.assign(
        rmse=tried["rmse"].fillna(METRICS["rmse"].worst),
        bounding=tried["gap"].notna(),
        certified=tried["status"].eq("optimal"),
    )
    keys = ["model", "test", "method"]
    grouped = tried.groupby(keys, sort=False)
    table = grouped.agg(
        display_name=("display_name", "first"),
        runs=("run_id", "size"),
        median_rmse=("rmse", "median"),
        success=("success", "mean"),
        median_time_s=("time_solve_s", "median"),
        bounding=("bounding", "any"),
        certified=("certified", "mean"),
        median_bound_ratio=("bound_ratio", "median"),
        failed=("outcome", lambda outcomes: int(outcomes.eq("failed").sum())),
    )
    return table.reset_index()


def _distinct_names(runs: pd.DataFrame) -> pd.DataFrame:
    """Add the names of methods that share a displayed name."""
    shared = runs.groupby("display_name")["method"].transform("nunique") > 1
    both = runs["display_name"] + " [" + runs["method"] + "]"
    return runs.assign(display_name=runs["display_name"].mask(shared, both))


def print_summary(folder: Path, console: Console | None = None) -> None:
    """Print results per method and test, runs without a result and why, and the path of the report."""
    console = console or Console(width=None if os.isatty(1) else 120)
    runs = _distinct_names(records.read(folder / "tables" / "runs.parquet", records.runs_columns()))
    for model, part in summarise(runs).groupby("model", sort=False):
        console.print(_table(str(model), part))
    console.print(
        "[dim]RMSE over the true pairs, target units (∞: no pose); L/U: lower bound divided by upper "
        "bound, over all runs with bounds.[/dim]"
    )
    for outcome in ("unavailable", "unsupported", "failed"):
        these = runs[runs["outcome"] == outcome]
        for (name, message), group in these.groupby(["display_name", "message"], sort=False):
            console.print(f"{outcome}: {name} ({len(group)} runs): {message}", markup=False)
    report = folder / "report" / "index.html"
    if folder.parent.name == "parts":
        _print_path("this is a part; the whole experiment is in", folder.parents[1], console)
    _print_path("report:" if report.is_file() else "no report yet:", report, console)


def print_plan(plan: Plan, folder: Path, cores: int, console: Console | None = None) -> None:
    """Print the planned runs with their estimated time, and the path of their report."""
    console = console or Console(width=None if os.isatty(1) else 120)
    table = Table(title=f"{plan.experiment.name}", title_justify="left", title_style="bold")
    for name in ("method", "model", "tests"):
        table.add_column(name)
    for name in ("runs", "finished", "time of the rest"):
        table.add_column(name, justify="right")
    outlook = outlook_of(plan, folder)
    for row in outlook:
        time = _duration(row.seconds)
        table.add_row(
            *(row.method, row.model, ", ".join(row.tests)),
            *(str(row.runs), str(row.finished), time if row.known else f"at most {time}"),
        )
    console.print(table)
    for note in size_notes(plan):
        console.print(note, markup=False, highlight=False)
    seconds = sum(row.seconds for row in outlook)
    at_most = "" if all(row.known for row in outlook) else "at most "
    console.print(
        f"{sum(row.runs for row in outlook)} runs, {sum(row.finished for row in outlook)} of them "
        f"finished; the rest takes {at_most}about {_duration(seconds / cores)} on {cores} cores, "
        "without the start and the compilation of methods"
    )
    _print_path("report:", folder / plan.view / "report" / "index.html", console)


def _print_path(words: str, path: Path, console: Console) -> None:
    """Print on a single line, so that the path can be copied."""
    console.print(f"{words} {os.path.relpath(path)}", soft_wrap=True, markup=False)


@dataclass(frozen=True)
class Outlook:
    """The planned runs of a method on one model, and the estimated seconds of the unfinished ones.

    ``known``: every unfinished run is estimated by the median time of the method's finished runs on its
    test, including those of the quick part; a run that hit its time limit counts as the current limit.
    Runs without an estimate count as the time limit.
    """

    method: str
    model: str
    tests: list[str]
    runs: int
    finished: int
    seconds: float
    known: bool


def outlook_of(plan: Plan, folder: Path) -> list[Outlook]:
    """Estimate the time of each method and model of a plan, given the finished runs in `folder`."""
    planned = list(plan.runs())
    rows: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in planned:
        rows.setdefault((run.method.name, run.chunk.model), []).append(run)
    kept = _kept(plan, folder)
    measured = _times(planned, kept, plan.experiment)
    for quick in _quick_part(plan):
        rows_of_quick = _kept(quick, folder.with_name(quick.experiment.name))
        of_quick = _times(quick.runs(), rows_of_quick, plan.experiment)
        measured = {**of_quick, **measured}
    outlook = []
    for (name, model), runs in rows.items():
        method = runs[0].method
        fingerprint = registry.fingerprint(method.baseline)
        runs_here = _runs_here(method)
        finished, seconds, known = 0, 0.0, True
        for run in runs:
            if kept.get(run.run_id, {}).get("fingerprint") == fingerprint:
                finished += 1
                continue
            if not runs_here:  # ends at once as unavailable
                continue
            taken = measured.get((name, model, run.instance.test))
            known = known and taken is not None
            seconds += np.median(taken) if taken else plan.experiment.limits_of(method).time_s
        tests = list(dict.fromkeys(run.instance.test for run in runs))
        outlook.append(Outlook(name, model, tests, len(runs), finished, float(seconds), known))
    return outlook


def _runs_here(method: MethodSettings) -> bool:
    try:
        return registry.load(method.baseline, **method.options).available() is None
    except ImportError:
        return False


def _kept(plan: Plan, folder: Path) -> dict[str, dict[str, Any]]:
    """Return the finished runs of the plan's methods by run_id, if possible those of the present code."""
    kept: dict[str, dict[str, Any]] = {}
    for method in plan.methods:
        fingerprint = registry.fingerprint(method.baseline)
        finished = {**archived(method.name), **journalled(folder / "runs" / method.name)}
        for row in finished.values():
            if kept.get(row["run_id"], {}).get("fingerprint") != fingerprint:
                kept[row["run_id"]] = row
    return kept


def _times(
    runs: Iterable[PlannedRun], kept: dict[str, dict[str, Any]], experiment: Experiment
) -> dict[tuple[str, str, str], list[float]]:
    """Return the seconds of finished runs per method, model and test under the limits of an experiment.

    A run that hit a limit of work counts as the time limit if the experiment has no such limit.
    """
    limits_of = {method.name: experiment.limits_of(method) for method in experiment.methods}
    times: dict[tuple[str, str, str], list[float]] = {}
    for run in runs:
        row, limits = kept.get(run.run_id, {}), limits_of.get(run.method.name)
        if limits is None or (time := row.get("time_solve_s")) is None:
            continue
        limited = {
            Status.NODE_LIMIT: limits.nodes is None,
            Status.ASSIGNMENT_LIMIT: limits.assignments is None,
        }
        if limited.get(row["status"], row["status"] == Status.TIME_LIMIT):
            time = limits.time_s
        key = run.method.name, run.chunk.model, run.instance.test
        times.setdefault(key, []).append(time)
    return times


def _quick_part(plan: Plan) -> Iterator[Plan]:
    """Yield the plan of the experiment's quick part, if it has one."""
    with suppress(ConfigError):
        yield expand(load(f"{plan.config}{QUICK}"))


def print_baselines(console: Console | None = None) -> None:
    """Print a table of all methods, including those of extra folders."""
    head = ("baseline", "method", "models", "version", "provenance", "language", "certifies")
    table = Table(*head, "available")
    citations = []
    for row in registry.availability():
        available = "yes" if row["available"] else f"no: {row['reason']}"
        facts = ("name", "method", "models", "version", "provenance", "language", "bounds")
        table.add_row(*(str(row[key]) for key in facts), escape(available))
        citations.append(f"{row['method']}: {row['citation']}")
    console = console or Console(width=None if os.isatty(1) else 180)
    console.print(table)
    console.print(
        "In a config: methods: [{name: any, baseline: BASELINE}]; in any experiment: make run METHODS="
        "BASELINE,dcreg\n",
        highlight=False,
    )
    for kind, origin in added_by_packages():
        console.print(f"{kind}: {origin}", highlight=False, markup=False, soft_wrap=True)
    console.print("\n".join(citations), highlight=False, markup=False)


def added_by_packages() -> Iterator[tuple[str, str]]:
    """Yield what installed packages add, with its origin, and for metrics whether they are left out."""
    for plugin in plugins(registry.GROUP):
        yield "added method", plugin.origin
    for plugin in plugins(DATASETS):
        yield "added dataset", plugin.origin
    for plugin in plugins(ADDED_METRICS):
        reason = BROKEN.get(plugin.origin)
        yield "added metrics", f"{plugin.origin}" + (f", left out: {reason}" if reason else "")


def _table(model: str, part: pd.DataFrame) -> Table:
    table = Table(title=f"{model}", title_justify="left", title_style="bold")
    table.add_column("test")
    table.add_column("method")
    for name in ("runs", "median RMSE", "success", "median time", "certified", "median L/U"):
        table.add_column(name, justify="right")
    for test, rows in part.groupby("test", sort=False):
        for index, row in enumerate(rows.to_dict("records")):
            table.add_row(
                str(test) if index == 0 else "",
                escape(row["display_name"]),
                str(row["runs"]),
                _number(row["median_rmse"]),
                f"{row['success']:.0%}",
                _seconds(row["median_time_s"]),
                f"{row['certified']:.0%}" if row["bounding"] else "–",
                _share(row["median_bound_ratio"]) if row["bounding"] else "–",
            )
        table.add_section()
    return table


def _share(value: float) -> str:
    return "–" if np.isnan(value) else percent(value)


def _number(value: float) -> str:
    if np.isnan(value):
        return "–"
    return "∞" if np.isinf(value) else f"{value:.4f}"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _seconds(value: float) -> str:
    if np.isnan(value):
        return "–"
    return f"{1e3 * value:.1f} ms" if value < 1 else f"{value:.2f} s"
