"""The summary after a run, the table of a plan, and the list of methods."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from baselines import registry
from data.registry import GROUP as DATASETS
from dcreg.plugins import plugins
from dcreg.text import percent
from workflows import records
from workflows.labels import display_names, distinct
from workflows.metrics import BROKEN, METRICS
from workflows.metrics import GROUP as ADDED_METRICS
from workflows.outcomes import attempted, comparable_times
from workflows.outlook import duration, outlook_of
from workflows.stages.plan import Plan, size_notes

SUMMARISED = [
    "run_id", "model", "test", "method", "display_name", "status", "outcome", "rmse", "success", "gap",
    "bound_ratio",
]  # fmt: skip


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Summarise the attempted runs per method and test.

    A run without a pose counts with the worst RMSE and as no success, so that a method gains nothing by
    failing. Times are those of one machine; failed runs have none.
    """
    tried = attempted(runs[SUMMARISED].assign(time_solve_s=comparable_times(runs)))
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


def print_summary(folder: Path, console: Console | None = None) -> None:
    """Print results per method and test, runs without a result and why, and the path of the report."""
    console = console or Console(width=None if os.isatty(1) else 120)
    runs = records.read(folder / "tables" / "runs.parquet", records.runs_columns())
    names = distinct(dict(zip(runs["method"], runs["display_name"], strict=True)))
    runs = runs.assign(display_name=runs["method"].map(names))
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
    _print_report(report, console)


def print_plan(plan: Plan, folder: Path, cores: int, console: Console | None = None) -> None:
    """Print the planned runs with their estimated time, and the path of their report."""
    console = console or Console(width=None if os.isatty(1) else 120)
    table = Table(title=f"{plan.experiment.name}", title_justify="left", title_style="bold")
    for name in ("method", "key", "model", "tests"):
        table.add_column(name)
    for name in ("runs", "finished", "time of the rest"):
        table.add_column(name, justify="right")
    outlook = outlook_of(plan, folder)
    names = display_names(plan.experiment.methods)
    for row in outlook:
        time = duration(row.seconds)
        table.add_row(
            *(escape(names[row.method]), row.method, row.model, ", ".join(row.tests)),
            *(str(row.runs), str(row.finished), time if row.known else f"at most {time}"),
        )
    console.print(table)
    for note in size_notes(plan):
        console.print(note, markup=False, highlight=False)
    seconds = sum(row.seconds for row in outlook)
    about = "about" if all(row.known for row in outlook) else "at most"
    console.print(
        f"{sum(row.runs for row in outlook)} runs, {sum(row.finished for row in outlook)} of them "
        f"finished; the rest takes {about} {duration(seconds / cores)} on {cores} "
        f"core{'s' * (cores > 1)}, without the start and the compilation of methods"
    )
    _print_report(folder / plan.view / "report" / "index.html", console)


def _print_report(report: Path, console: Console) -> None:
    _print_path("report:" if report.is_file() else "no report yet:", report, console)


def _print_path(words: str, path: Path, console: Console) -> None:
    """Print on a single line, so that the path can be copied."""
    console.print(f"{words} {os.path.relpath(path)}", soft_wrap=True, markup=False)


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


def _seconds(value: float) -> str:
    if np.isnan(value):
        return "–"
    return f"{1e3 * value:.1f} ms" if value < 1 else f"{value:.2f} s"
