"""Verdicts on the claims of the paper, from the tables of several experiments.

``python -m reports claims`` writes ``claims.html``, where every claim has the address ``claims.html#ID``,
next to ``claims.csv``, ``comparisons.csv`` and the runs behind each verdict, ``data/ID.csv``. Claims
whose tables are missing get the verdict "not run".
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.table import Table

from reports import templating
from reports.ledger.book import UNJUDGED, Ledger, ledger
from reports.ledger.evidence import STUDY, Evidence
from reports.ledger.judging import Judgement, as_table, comparisons, count, judge
from reports.tables import ReportError

PAGE = "claims.html"


def write(book: Ledger, judgements: list[Judgement], evidence: Evidence, out: Path) -> Path:
    """Write tables, data and page to the folder `out`; return the path of the page."""
    (out / "data").mkdir(parents=True, exist_ok=True)
    as_table(judgements).to_csv(out / "claims.csv", index=False)
    comparisons(judgements).to_csv(out / "comparisons.csv", index=False)
    for found in judgements:
        path = out / "data" / f"{found.id}.csv"
        path.unlink(missing_ok=True)
        if len(found.data):
            found.data.to_csv(path, index=False)
    page = out / PAGE
    page.write_text(
        templating.environment()
        .get_template(PAGE)
        .render(
            kinds=UNJUDGED,
            judgements=judgements,
            counts=count(judgements),
            facts=book.facts,
            notes=evidence.notes,
            seen=[
                *(found.tables.experiment for found in evidence.experiments.values()),
                *([STUDY] if evidence.study else []),
            ],
        ),
        encoding="utf-8",
    )
    return page


def _print(judgements: list[Judgement]) -> None:
    table = Table("claim", "verdict", "evidence", "reason")
    for found in judgements:
        table.add_row(found.id, found.verdict, found.evidence, found.reason)
    console = Console()
    console.print(table, markup=False)
    console.print(", ".join(f"{number} {verdict}" for verdict, number in count(judgements)))


def _print_changes(judgements: list[Judgement], before: Path) -> None:
    """Print the claims whose verdict differs from that in an earlier ``claims.csv``."""
    if not before.is_file():
        raise ReportError(f"{before}: no such file; give the claims.csv of an earlier check")
    earlier = pd.read_csv(before).set_index("id")["verdict"]
    table = Table("claim", "before", "now", "reason")
    for found in judgements:
        if (was := earlier.get(found.id, "absent")) != found.verdict:
            table.add_row(found.id, was, found.verdict, found.because or found.reason)
    Console().print(table, markup=False)


def check(results: list[Path], out: Path, before: Path | None = None) -> None:
    """Judge all claims by the tables in `results`, print the verdicts and write the page to `out`.

    `results` are folders of results, or folders that contain such folders. With `before`, the
    ``claims.csv`` of an earlier check, print the verdicts that changed.
    """
    for folder in results:
        if not folder.is_dir():
            raise ReportError(f"{folder}: no such folder; name a folder of results")
    book, evidence = ledger(), Evidence.of_folders(results)
    judgements = judge(book, evidence)
    _print(judgements)
    if before:
        _print_changes(judgements, before)
    for note in evidence.notes:
        print(f"note: {note}")
    print(f"page: {write(book, judgements, evidence, out)}")
