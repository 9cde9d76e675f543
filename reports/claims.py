"""Verdicts on the claims of the paper: ``python -m reports.claims [RESULTS ...]``.

Reads the tables of several experiments, given as folders of results or as folders that hold such, and
writes ``claims.csv`` and ``index.html`` to ``results/claims``. Claims whose tables are not there are
"not run".
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from reports import templating
from reports.ledger.evidence import STUDY, Evidence
from reports.ledger.judging import Judgement, Ledger, as_table, count, judge, ledger
from reports.tables import ReportError
from workflows.records import SchemaError

HERE = Path(__file__).parent


def write(book: Ledger, judgements: list[Judgement], evidence: Evidence, out: Path) -> Path:
    """Write the table of verdicts and its page to the folder `out`. Returns the page's path."""
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


def main(
    results: Annotated[
        list[Path] | None, typer.Argument(help="folders of results, or one that holds them")
    ] = None,
    out: Annotated[Path, typer.Option(help="folder for table and page")] = Path("results/claims"),
) -> None:
    """Judge the claims of the paper by the tables at hand."""
    try:
        for folder in results or []:
            if not folder.is_dir():
                raise ReportError(f"{folder}: no such folder; name one of results")
        book, evidence = ledger(), Evidence.of_folders(results or [Path("results")])
    except (ReportError, SchemaError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    judgements = judge(book, evidence)
    _print(judgements)
    for note in evidence.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"page: {write(book, judgements, evidence, out)}")


if __name__ == "__main__":
    typer.run(main)
