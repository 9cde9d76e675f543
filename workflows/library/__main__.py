"""Make, solve and record the problem library; run other methods on it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from workflows.cli import user_errors

app = typer.Typer(help=__doc__, add_completion=False, no_args_is_help=True)

Names = Annotated[
    list[str] | None, typer.Argument(help="Names of problems or prefixes of names; default: all.")
]
Limit = Annotated[float, typer.Option(help="CPU time per solve, in seconds.", min=0.1)]


@app.command()
@user_errors
def generate() -> None:
    """Write the files of new problems. Existing files never change."""
    from workflows.library.generate import generate as write_problems

    print(f"{len(write_problems())} problems")


@app.command()
@user_errors
def solve(names: Names = None, limit: Limit = 10.0) -> None:
    """Solve problems with and without a certificate; continue where an earlier call ended."""
    from workflows.library.choose import chosen
    from workflows.library.solve import solve_all

    solve_all(chosen(names), limit)


@app.command()
@user_errors
def record(names: Names = None) -> None:
    """Check the answers of `solve` like submissions, and add them to the records."""
    from workflows.library.choose import chosen
    from workflows.library.recording import record_answers

    for line in record_answers(chosen(names)):
        print(line)


@app.command()
@user_errors
def prove(
    name: Annotated[str, typer.Argument(help="NAME or NAME@VERSION.")],
    out: Annotated[Path, typer.Argument(help="Certificate to write.")],
    limit: Limit = 60.0,
) -> None:
    """Make the proof of a problem again."""
    from data.library.problem import find_problem
    from workflows.library.solve import prove as make_proof

    print(make_proof(find_problem(name), out, limit))


@app.command()
@user_errors
def reprove(names: Names = None, limit: Limit = 60.0) -> None:
    """Make and check again all proofs that are too large to be stored; exit code 1 if a bound is lost."""
    from workflows.library.choose import chosen
    from workflows.library.solve import reprove as make_again

    is_complete = True
    for line, holds in make_again(chosen(names), limit):
        print(line if holds else f"FAULT: {line}", flush=True)
        is_complete = is_complete and holds
    raise typer.Exit(int(not is_complete))


@app.command()
@user_errors
def run(
    method: Annotated[str, typer.Argument(help="A method of `make baselines`.")] = "dcreg",
    names: Names = None,
    limit: Annotated[
        float, typer.Option(help="Wall time per problem, in seconds.", min=0.1)
    ] = 10.0,
) -> None:
    """Run a method on the problems and print a table of its verdicts."""
    from workflows.library.choose import chosen
    from workflows.library.running import run_method

    run_method(method, chosen(names), limit)


if __name__ == "__main__":
    app()
