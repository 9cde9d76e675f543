"""List and fetch the datasets of the benchmark."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from data.contract import DataError, Dataset
from data.fetch import cache_root
from data.registry import dataset, datasets

app = typer.Typer(help=__doc__, add_completion=False)
console = Console()


@app.command("list")
def list_all() -> None:
    """List every dataset with its shapes, tests and licence."""
    table = Table("name", "shapes", "tests (levels x trials)", "licence", title="Datasets")
    known = datasets()
    for name in known:
        try:
            found = known[name]
            shapes = ", ".join(found.shapes())
        except DataError as error:  # a wrong card must not hide the others
            table.add_row(name, f"[red]error:[/] {escape(str(error))}")
            continue
        tests = [f"{t} ({len(a.levels)} x {a.n_trials})" for t, a in found.tests().items()]
        table.add_row(name, shapes, "\n".join(tests) or "disturbances", found.card.licence)
    console.print(table)


@app.command()
def fetch(
    name: Annotated[str, typer.Argument(help="Folder of data/.")],
    shape: Annotated[list[str] | None, typer.Option(help="Only these shapes.")] = None,
    test: Annotated[list[str] | None, typer.Option(help="Only these tests.")] = None,
    trials: Annotated[int | None, typer.Option(help="Only the first trials of a level.")] = None,
) -> None:
    """Fetch and verify the files of a dataset, or of a part of it."""
    try:
        paths = _fetch(dataset(name), shape, test, trials)
    except DataError as error:
        Console(stderr=True).print(f"[red]error:[/] {error}", highlight=False, soft_wrap=True)
        raise typer.Exit(2) from None
    console.print(f"{len(paths)} verified files of {name} below {cache_root()}", soft_wrap=True)


def _fetch(
    found: Dataset, shapes: list[str] | None, tests: list[str] | None, trials: int | None
) -> set[str]:
    paths: set[str] = set()
    for shape in shapes or found.shapes():
        axes = found.tests()
        if not axes:
            paths.update(map(str, found.fetch(shape)))
        for test in (tests or list(axes)) if axes else []:
            # An unknown test has no axis; `fetch` then reports it.
            axis = axes.get(test)
            for level in axis.levels if axis else (0.0,):
                for trial in range(min(trials or axis.n_trials, axis.n_trials) if axis else 1):
                    paths.update(map(str, found.fetch(shape, test, level, trial)))
    return paths


if __name__ == "__main__":
    app()
