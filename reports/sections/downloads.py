"""The raw tables, inside the page."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import pandas as pd

from reports.page import Page
from reports.tables import thin_trace

ID = "downloads"
TITLE = "Raw tables"
POSITION = 110

MAX_TRACE_BYTES = 2_000_000  # compressed; longer histories are reduced to the changes of a bound
MAX_RUNS, MAX_EVENTS = 30_000, 200_000  # rows inside the page, about 10 MB
STEPS = 50  # events of a reduced history


def context(page: Page) -> dict[str, Any]:
    tables, left_out = page.tables, []
    if len(tables.runs) <= MAX_RUNS:
        page.add_download(
            "runs.csv", _csv(tables.directory / "runs.csv", tables.runs), "one row per planned run"
        )
    else:
        left_out.append(("runs.parquet", len(tables.runs)))
    if (events := tables.count_events()) <= MAX_EVENTS:
        _add_traces(page)
    else:
        left_out.append(("traces.parquet", events))
    page.add_download(
        "accounting.csv",
        _csv(tables.directory / "accounting.csv", tables.accounting),
        "planned runs and their outcomes per method",
    )
    path = tables.directory / "provenance.json"
    if path.exists():
        page.add_download("provenance.json", path.read_bytes(), "versions, machine, config, cards")
    names = ("runs.csv", "traces.csv", "traces-steps.csv", "accounting.csv", "provenance.json")
    return {
        "files": [page.downloads[name] for name in names if name in page.downloads],
        "left_out": [(f"{tables.directory.name}/{name}", count) for name, count in left_out],
    }


def _add_traces(page: Page) -> None:
    tables = page.tables
    full = _csv(tables.directory / "traces.csv", tables.traces)
    if len(gzip.compress(full)) <= MAX_TRACE_BYTES:
        page.add_download("traces.csv", full, "bound histories, every event")
        return
    groups = tables.traces.groupby(["run_id", "stage"], sort=False)
    page.add_download(
        "traces-steps.csv",
        _csv(None, pd.concat([thin_trace(part, most=STEPS) for _, part in groups])),
        "bound histories, changes of a bound only; tables/traces.csv has all events",
    )


def _csv(path: Path | None, table: pd.DataFrame) -> bytes:
    """Return the file of the aggregate stage, or the table as CSV if there is none."""
    if path is not None and path.exists():
        return path.read_bytes()
    return table.to_csv(index=False).encode("utf-8")
