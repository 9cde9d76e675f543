"""What is printed at the end of a run, and the list of methods."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from workflows import methods, records
from workflows.metrics import METRICS


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Per method and test, over all runs that were possible.

    A run without a pose counts with the worst RMSE and as no success: dropping it would make a
    method look better the more it fails.
    """
    tried = runs[~runs["outcome"].isin(("unsupported", "unavailable"))]
    tried = tried.assign(
        rmse=tried["rmse"].fillna(METRICS["rmse"].worst),
        bounding=tried["gap"].notna(),
        certified=tried["status"].eq("optimal"),
        # Per pair and as a length, so that instances with different numbers of pairs compare.
        gap_rms=np.sqrt(tried["gap"] / tried["n_inliers"]),
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
        median_gap_rms=("gap_rms", "median"),
        failed=("outcome", lambda outcomes: int(outcomes.eq("failed").sum())),
    )
    return table.reset_index()


def print_summary(folder: Path, console: Console | None = None) -> None:
    """The table method × test, what could not run and why, and where the report is."""
    console = console or Console(width=None if os.isatty(1) else 120)
    runs = records.read(folder / "tables" / "runs.parquet", records.runs_columns())
    for model, part in summarise(runs).groupby("model", sort=False):
        console.print(_table(str(model), part))
    console.print(
        "[dim]RMSE over the true pairs, target units (∞: no pose); gap as RMS per pair "
        "√(gap / n_inliers).[/dim]"
    )
    for outcome in ("unavailable", "unsupported", "failed"):
        these = runs[runs["outcome"] == outcome]
        for (name, message), group in these.groupby(["display_name", "message"], sort=False):
            console.print(f"{outcome}: {name} ({len(group)} runs): {message}", markup=False)
    report = folder / "report" / "index.html"
    shown = os.path.relpath(report)
    console.print(f"report: {shown}" if report.is_file() else f"no report yet at {shown}")


def print_baselines(console: Console | None = None) -> None:
    """Table of all methods, those of extra folders included."""
    from baselines import registry

    table = Table("method", "models", "version", "provenance", "certifies", "available")
    citations = []
    for root in methods.roots():
        for row in registry.availability(root):
            available = "yes" if row["available"] else f"no: {row['reason']}"
            cells = [row[key] for key in ("method", "models", "version", "provenance", "bounds")]
            table.add_row(*map(str, cells), available)
            citations.append(f"{row['method']}: {row['citation']}")
    console = console or Console(width=None if os.isatty(1) else 180)
    console.print(table)
    console.print("\n".join(citations), highlight=False, markup=False)


def _table(model: str, part: pd.DataFrame) -> Table:
    table = Table(title=f"{model}", title_justify="left", title_style="bold")
    table.add_column("test")
    table.add_column("method")
    for name in ("runs", "median RMSE", "success", "median time", "certified", "median gap"):
        table.add_column(name, justify="right")
    for test, rows in part.groupby("test", sort=False):
        for index, row in enumerate(rows.to_dict("records")):
            table.add_row(
                str(test) if index == 0 else "",
                row["display_name"],
                str(row["runs"]),
                _number(row["median_rmse"]),
                f"{row['success']:.0%}",
                _seconds(row["median_time_s"]),
                f"{row['certified']:.0%}" if row["bounding"] else "–",
                _number(row["median_gap_rms"]) if row["bounding"] else "–",
            )
        table.add_section()
    return table


def _number(value: float) -> str:
    if np.isnan(value):
        return "–"
    return "∞" if np.isinf(value) else f"{value:.4f}"


def _seconds(value: float) -> str:
    if np.isnan(value):
        return "–"
    return f"{1e3 * value:.1f} ms" if value < 1 else f"{value:.2f} s"
