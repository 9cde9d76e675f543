"""The tables of results in a report as CSV files: ``python -m reports tables TABLES OUT``.

They are those of the page, without its figures, parameters and provenance, for experiments with more
runs than a page can show.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from dcreg.files import whole_file
from reports import measured, theme
from reports.figures import attribution, levels
from reports.ledger.evidence import Evidence
from reports.ledger.judging import as_table, comparisons, judge, ledger
from reports.page import Page
from reports.sections import failures, outcome, overview, parameters
from reports.tables import Tables, count_outcomes
from workflows.metrics import METRICS


def write(tables_dir: Path, out: Path) -> list[Path]:
    """Write the tables of the report of an experiment to the folder `out`; return their paths.

    Parameters
    ----------
    tables_dir : Path
        ``results/<experiment>/tables``.
    out : Path

    Raises
    ------
    ReportError, SchemaError
    """
    tables = Tables.load(tables_dir)
    page = Page(tables, theme.method_styles(tables), out)
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for name, table in _tables(page):
        written.append(out / f"{name}.csv")
        with whole_file(written[-1]) as part:
            table.to_csv(part, index=False)
    return written


def _tables(page: Page) -> Iterator[tuple[str, pd.DataFrame]]:
    tables = page.tables
    yield "outcome", pd.DataFrame(outcome.outcomes(tables))
    yield "accounting", count_outcomes(tables.runs).loc[tables.methods].reset_index()
    yield "tests", pd.DataFrame([_flat(row) for row in overview.summary(tables)])
    yield "levels", pd.concat(_levels(tables), ignore_index=True)
    judgements = judge(ledger(), evidence := Evidence.of_tables(tables), set(evidence.experiments))
    yield "claims", as_table(judgements)
    yield "comparisons", comparisons(judgements)
    del judgements, evidence
    for model in tables.runs["model"].unique():
        for name in ("separation", "effects"):
            if shown := getattr(measured, name)(page.measured, model):
                yield f"{name}-{model}", _frame(shown)
    if stages := measured.boxes_per_stage(page.measured):
        yield "stages", _frame(stages)
    yield (
        "failures",
        pd.DataFrame(failures.context(page)["groups"]).drop(columns="runs", errors="ignore"),
    )
    runs = attribution.judged(tables.runs)
    yield "attribution", attribution.count(runs, tables.methods).reset_index()
    counted = [
        counts.reset_index().assign(model=model, test=test)
        for model, test, counts in attribution.count_by_test(runs, tables.methods)
    ]
    yield "attribution-tests", pd.concat(counted, ignore_index=True)
    columns = ["model", "test", "level", "minimum", "median", "maximum"]
    yield "noise-bounds", pd.DataFrame(parameters.bounds(tables.runs), columns=columns)


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of the accounting with its results as columns."""
    results = {} if row["result"] is None else row["result"].to_dict()
    return {**{name: value for name, value in row.items() if name != "result"}, **results}


def _levels(tables: Tables) -> Iterator[pd.DataFrame]:
    """Yield what the figures of error and time against the level show."""
    for model in tables.runs["model"].unique():
        runs = levels.prepare(tables, model)
        for column in (*levels.available_errors(runs), "time_solve_s"):
            rows = runs if column in METRICS else runs.assign(row="")
            found = pd.DataFrame(levels.statistics(rows, column))
            yield found.assign(model=model, quantity=column)


def _frame(shown: measured.Shown) -> pd.DataFrame:
    return pd.DataFrame(shown.rows, columns=list(shown.columns))
