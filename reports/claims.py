"""Verdicts on the claims of the paper, from the tables of several experiments.

``python -m reports claims`` writes ``claims.csv`` and ``index.html``. Claims whose tables are missing get
the verdict "not run".
"""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from reports import templating
from reports.ledger.evidence import STUDY, Evidence
from reports.ledger.judging import Judgement, Ledger, as_table, count, judge, ledger
from reports.tables import ReportError

HERE = Path(__file__).parent


def write(book: Ledger, judgements: list[Judgement], evidence: Evidence, out: Path) -> Path:
    """Write the table of verdicts and its page to the folder `out`; return the path of the page."""
    out.mkdir(parents=True, exist_ok=True)
    as_table(judgements).to_csv(out / "claims.csv", index=False)
    page = out / "index.html"
    page.write_text(
        templating.environment()
        .get_template("claims.html")
        .render(
            css=(HERE / "assets" / "report.css").read_text(encoding="utf-8"),
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


def check(results: list[Path], out: Path) -> None:
    """Judge all claims by the tables in `results`, print the verdicts and write the page to `out`.

    `results` are folders of results, or folders that contain such folders.
    """
    for folder in results:
        if not folder.is_dir():
            raise ReportError(f"{folder}: no such folder; name a folder of results")
    book, evidence = ledger(), Evidence.of_folders(results)
    judgements = judge(book, evidence)
    _print(judgements)
    for note in evidence.notes:
        print(f"note: {note}")
    print(f"page: {write(book, judgements, evidence, out)}")
