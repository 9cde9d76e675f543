"""The stages as commands, for the rules of Snakemake: hidden commands of ``python -m workflows``.

Modules are imported inside the commands, so that no stage waits for what only others need.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from workflows.cli import Experiment, Folder, Out, say, user_errors

if TYPE_CHECKING:
    from workflows.stages.plan import Plan

app = typer.Typer()

Select = Annotated[
    list[str] | None,
    typer.Option(help="Part of the grid, such as tests=noise,deformation; may be repeated."),
]
Blocks = Annotated[
    Path | None, typer.Option("--needs", help="File with the needed blocks of every method.")
]


known: Plan | None = None  # the plan, in a process that received it


def planned(experiment: str, select: list[str] | None = None, needs: Path | None = None) -> Plan:
    """Return the plan of an experiment, of a part of it, or of the blocks in the file `needs`."""
    if known is not None:
        return known
    from workflows.blocks import Needs
    from workflows.config import load, origin, parse_selection
    from workflows.stages.plan import expand

    blocks = Needs.read(needs) if needs else None
    return expand(load(experiment), parse_selection(select or []), origin(experiment), blocks)


@app.command(hidden=True)
@user_errors
def plan(experiment: Experiment, out: Out, select: Select = None, needs: Blocks = None) -> None:
    """Write the table of planned runs."""
    from workflows import records
    from workflows.stages.plan import plan_table

    records.write(plan_table(planned(experiment, select, needs)), out)


@app.command(hidden=True)
@user_errors
def fetch(
    experiment: Experiment,
    chunk: Annotated[str, typer.Option()],
    out: Out,
    select: Select = None,
    needs: Blocks = None,
) -> None:
    """Fetch and verify the files that the instances of a chunk need."""
    from workflows.stages.fetch import fetch as fetch_files

    needed = planned(experiment, select, needs).chunk(chunk)
    fetch_files(needed, out)
    say(f"fetch     {', '.join(needed.datasets)} for {chunk}")


@app.command(hidden=True)
@user_errors
def generate(
    experiment: Experiment,
    chunk: Annotated[str, typer.Option()],
    instances: Out,
    truth: Out,
    select: Select = None,
    needs: Blocks = None,
) -> None:
    """Make the instances of a chunk, and their ground truth in a separate file."""
    from workflows.stages.generate import generate as generate_chunk

    specs = planned(experiment, select, needs).chunk(chunk)
    generate_chunk(specs, instances, truth)
    say(f"generate  {chunk}: {len(specs.instances)} instances")


@app.command(hidden=True)
@user_errors
def solve(
    experiment: Experiment,
    method: Annotated[str, typer.Option()],
    instances: Out,
    out: Out,
    truth: Annotated[
        Path | None, typer.Option(help="Ground truth, for the oracle front end only.")
    ] = None,
    select: Select = None,
    needs: Blocks = None,
) -> None:
    """Run a method on a chunk of instances."""
    # Raise, so that workers and their children are ended too.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    from workflows.stages.solve import solve as solve_chunk

    settings = planned(experiment, select, needs).experiment
    solve_chunk(
        settings,
        settings.method(method),
        instances,
        out,
        lambda line: print(line, flush=True),
        truth,
    )


@app.command(hidden=True)
@user_errors
def evaluate(folder: Folder, plan: Annotated[Path, typer.Option()], out: Out) -> None:
    """Compute all metrics."""
    from workflows import records
    from workflows.stages.evaluate import evaluate as judge

    metrics = judge(folder, plan)
    records.write(metrics, out)
    say(f"evaluate  {len(metrics)} runs")


@app.command(hidden=True)
@user_errors
def aggregate(
    experiment: Experiment, folder: Folder, select: Select = None, needs: Blocks = None
) -> None:
    """Write the tables."""
    from workflows.stages.aggregate import aggregate as join

    whole = planned(experiment, select, needs)
    join(whole, folder)
    say(f"aggregate {folder / whole.view / 'tables'}")
