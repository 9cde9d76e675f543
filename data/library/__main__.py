"""The problem library: list, show, check, and submit improvements."""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path
from typing import Annotated, NoReturn, get_args

import typer
from rich.console import Console
from rich.table import Column, Table

from data.contract import DataError
from data.library.problem import HERE, LibraryError, Problem, all_problems, find_problem
from data.library.record import Record, Status, read_record

app = typer.Typer(help=__doc__, add_completion=False, no_args_is_help=True)
console = Console(width=None if os.isatty(1) else 120)

Name = Annotated[str, typer.Argument(help="NAME (the newest version) or NAME@VERSION.")]


@app.command("list")
def list_all(
    status: Annotated[str, typer.Option(help="Only easy, hard or open problems.")] = "",
) -> None:
    """List all problems with their bounds and status."""
    if status not in ("", *(known := get_args(Status))):
        _stop(LibraryError(f"--status {status}: give one of {', '.join(known)}"))
    folded = [Column(name, overflow="fold") for name in ("problem", "model")]  # names are complete
    table = Table(*folded, "points", "pairs", "objective", "lower bound", "status",
                  "longest search, s")  # fmt: skip
    counts: Counter[str] = Counter()
    for problem in all_problems().values():
        record = read_record(problem.id)
        word = record.status(problem)
        counts[word] += 1
        if status in ("", word):
            table.add_row(
                problem.id, problem.model, f"{problem.n_source}, {problem.n_target}",
                str(problem.n_inliers), f"{record.objective:.6g}", f"{record.lower_bound:.6g}", word,
                f"{record.tried_s:.1f}" if word == "open" else "",
            )  # fmt: skip
    console.print(table)
    console.print(", ".join(f"{count} {word}" for word, count in sorted(counts.items())))


@app.command()
def show(name: Name) -> None:
    """Print what is known about a problem."""
    try:
        problem = find_problem(name)
        record = read_record(problem.id)
    except DataError as error:
        _stop(error)
    print(f"{problem.id}: {problem.title}")
    print(
        f"{problem.model}, n_inliers {problem.n_inliers}, unit: {problem.unit}, {problem.licence}"
    )
    print(f"status {record.status(problem)}, gap {record.gap:.3%}")
    for entry in record.entries:
        print(f"  {json.dumps(entry.model_dump(mode='json'))}")


@app.command()
def export(
    name: Name,
    folder: Annotated[Path, typer.Argument(help="Folder for source.txt and target.txt.")],
) -> None:
    """Write the clouds of a problem as text, and print the command that registers them."""
    try:
        problem = find_problem(name)
        clouds = problem.clouds
    except DataError as error:
        _stop(error)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _stop(error)
    paths = [folder / "source.txt", folder / "target.txt"]
    for path, points in zip(paths, clouds, strict=True):
        rows = (" ".join(map(repr, row)) for row in points.tolist())
        path.write_text("".join(f"{row}\n" for row in rows), encoding="utf-8")
    scales = f" --scale-range {problem.scale_range[0]} {problem.scale_range[1]}"
    print(
        f"dcreg register {paths[0]} {paths[1]} --model {problem.model} "
        f"--n-inliers {problem.n_inliers}{scales if problem.dim == 2 else ''}"
    )


@app.command()
def check(
    all_proofs: Annotated[
        bool, typer.Option("--all", help="Verify every stored proof, not a sample.")
    ] = False,
) -> None:
    """Check all files, all poses by two evaluators, and proofs by the independent checker."""
    from data.library.check import check as check_library

    done = check_library(lambda line: print(line, flush=True), every_proof=all_proofs)
    for line in done.no_data:
        print(f"no data   {line}")
    for line in done.faults:
        print(f"FAULT     {line}")
    if done.no_data:
        print(f"skipped   {len(done.no_data)} problems: data not available")
    if done.n_not_stored:
        reason = "not stored; `python -m workflows.library reprove` makes and checks them again"
        print(f"skipped   {done.n_not_stored} proofs: {reason}")
    if not all_proofs:
        rest = done.n_bounds - done.n_not_stored - done.n_proofs
        print(f"skipped   {rest} proofs: not in the sample; --all verifies them")
    print(
        f"checked   {done.n_problems} problems, {done.n_poses} poses by two evaluators, "
        f"{done.n_proofs} of {done.n_bounds} proofs; {len(done.faults)} faults"
    )
    raise typer.Exit(int(bool(done.faults)))


@app.command()
def submit(
    path: Annotated[Path, typer.Argument(help="JSON file; see docs/library.md.")],
) -> None:
    """Check a submission and add what it improves to the library; exit code 1 if a part is refused."""
    from data.library.submit import submit as check_submission

    try:
        outcome = check_submission(path)
    except DataError as error:
        _stop(error)
    for line in outcome.accepted:
        print(f"accepted  {line}")
    for line in outcome.refused:
        print(f"refused   {line}")
    raise typer.Exit(int(bool(outcome.refused)))


@app.command()
def schema() -> None:
    """Write the JSON Schemas of problems, records and submissions, and the list of checksums."""
    from data.library.check import write_checksums
    from data.library.submit import Submission

    for name, kind in (("problem", Problem), ("record", Record), ("submission", Submission)):
        path = HERE / f"{name}.schema.json"
        path.write_text(json.dumps(kind.model_json_schema(), indent=1) + "\n", encoding="utf-8")
        print(path)
    print(write_checksums())


def _stop(error: Exception) -> NoReturn:
    Console(stderr=True).print(f"[red]error:[/] {error}", highlight=False, soft_wrap=True)
    raise typer.Exit(2)


if __name__ == "__main__":
    app()
