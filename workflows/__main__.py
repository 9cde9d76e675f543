"""``python -m workflows``: the stages, as the Snakefile calls them, and what a person asks for.

Modules are imported inside the commands: a stage should not wait for what another one needs.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from data.contract import DataError
from dcreg.problem import suggestion
from dcreg.status import Status
from workflows import CHECKOUT, UserError

if TYPE_CHECKING:
    from workflows.stages.plan import Plan

BEGAN = time.perf_counter()

app = typer.Typer(
    help=__doc__, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False
)

Experiment = Annotated[str, typer.Argument(help="Name of a config, or path of one.")]
Select = Annotated[
    list[str] | None,
    typer.Option(help="Part of the grid, as tests=noise,deformation; can be repeated."),
]
Axis = Annotated[str, typer.Option(help="Only these, comma-separated.", rich_help_panel="Part of")]
Folder = Annotated[Path, typer.Argument(help="Results of an experiment: results/<name>.")]
Out = Annotated[Path, typer.Option()]


def user_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """End with exit code 2 and a message, without a traceback, for what a user can mend."""

    @wraps(command)
    def checked(*arguments: Any, **options: Any) -> Any:
        try:
            return command(*arguments, **options)
        except (ValueError, DataError) as error:
            from baselines.registry import BaselineError

            if isinstance(error, UserError | BaselineError | DataError):
                _stop(str(error))
            raise

    return checked


# --- what a person asks for --------------------------------------------------------------------


@app.command()
@user_errors
def run(
    experiment: Experiment,
    methods: Axis = "",
    datasets: Axis = "",
    shapes: Axis = "",
    tests: Axis = "",
    levels: Axis = "",
    trials: Axis = "",
    cores: Annotated[str, typer.Option(help="Number of cores, or all.")] = "all",
    directory: Annotated[Path, typer.Option(help="Where results/ lies.")] = CHECKOUT,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only show what would run.")] = False,
    timing: Annotated[bool, typer.Option("--timing", help="One solve job at a time.")] = False,
    no_report: Annotated[bool, typer.Option("--no-report", help="End with the tables.")] = False,
) -> None:
    """Run an experiment, or a selected part of it, and print the summary.

    A part has tables and a report of its own, in results/NAME/parts.
    """
    axes = {
        "methods": methods,
        "datasets": datasets,
        "shapes": shapes,
        "tests": tests,
        "levels": levels,
        "trials": trials,
    }
    select = [f"{axis}={values}" for axis, values in axes.items() if values]
    if cores != "all" and not (cores.isdecimal() and int(cores)):
        raise UserError(f"--cores {cores}: give a number from 1, or all")
    plan = _plan(experiment, select)
    name = plan.experiment.name
    folder = directory / "results" / name
    if dry_run:
        from workflows.summary import print_plan

        print_plan(
            plan, folder, 1 if timing else os.cpu_count() or 1 if cores == "all" else int(cores)
        )
        return
    print(
        f"plan      {name}: {sum(len(chunk.instances) for _, chunk in plan.jobs())} runs of "
        f"{sum(len(chunk.instances) for chunk in plan.chunks)} instances "
        f"and {len(plan.methods)} methods",
        flush=True,
    )
    if Path(experiment).is_file():
        experiment = str(Path(experiment).resolve())
    from workflows.running import INTERRUPTED, run_snakemake

    arguments = [
        *(["tables"] if no_report else []),
        *("--cores", cores),
        *("--resources", "fetching=1", *(["timing=1"] if timing else [])),
        *("--config", f"experiment={experiment}", f"select={' '.join(select)}"),
    ]
    if code := run_snakemake(directory, name, arguments):
        what = (
            "stopped"
            if code == INTERRUPTED
            else "not all stages came through; their messages are above"
        )
        print(
            f"error: {what}. Runs that finished are kept: the same command goes on from here.",
            file=sys.stderr,
        )
        raise typer.Exit(code)
    _say("all stages")
    summary(folder / plan.view)


@app.command()
@user_errors
def summary(folder: Folder) -> None:
    """Method × test: median RMSE, success, median time, certified share; path of the report."""
    from workflows.summary import print_summary

    print_summary(folder)


@app.command()
@user_errors
def record(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(help="Results to keep; by default demo and real2d, where present."),
    ] = None,
    version: Annotated[str, typer.Option(help="Name; by default from git.")] = "",
    history: Annotated[Path, typer.Option()] = Path("history"),
) -> None:
    """Keep the small tables of experiments under a version, for later comparison."""
    from workflows.compare import record as keep
    from workflows.compare import results_to_record

    for folder in folders or results_to_record():
        print(f"recorded  {keep(folder, history, version)}")


@app.command()
@user_errors
def compare(
    base: Annotated[str, typer.Argument(help="Recorded version, or a folder of records.")],
    head: Annotated[str, typer.Argument(help="The version to judge.")],
    history: Annotated[Path, typer.Option()] = Path("history"),
    json_out: Annotated[Path | None, typer.Option("--json", help="Verdicts as a file.")] = None,
) -> None:
    """Verdict per metric. Exit code 0: no regression, 1: regression, 2: not comparable."""
    from workflows.compare import compare as judge
    from workflows.compare import print_verdicts, regressed

    verdicts = judge(base, head, history)
    print_verdicts(verdicts, base, head)
    if json_out:
        json_out.write_text(verdicts.to_json(orient="records", indent=1), encoding="utf-8")
    raise typer.Exit(1 if regressed(verdicts) else 0)


@app.command()
@user_errors
def same(
    first: Folder, second: Annotated[Path, typer.Argument(help="Results of the same config.")]
) -> None:
    """Which runs of two executions differ, times apart. Exit code 1: more than the clock explains."""
    from workflows.same import differences, print_differences, read

    found = differences(read(first), read(second))
    print_differences(found)
    raise typer.Exit(1 if found.unexplained else 0)


@app.command()
@user_errors
def replay(experiment: Experiment, run_id: str) -> None:
    """Repeat one run outside the sandbox and print what the method answers."""
    from workflows.replay import replay as repeat

    print(json.dumps(repeat(_plan(experiment), run_id), indent=1))


@app.command()
@user_errors
def forget(
    folder: Folder,
    status: Annotated[str, typer.Option(help="Statuses, comma-separated.")] = "failed",
) -> None:
    """Drop runs that ended so, so that the next `run` repeats them and no others."""
    import shutil

    from workflows.stages.solve import forget as drop

    known = [str(each.value) for each in Status]
    for name in (statuses := set(status.split(","))):
        if name not in known:
            raise UserError(f"--status: {name!r} is none{suggestion(name, known)}")
    dropped = drop(folder / "runs", statuses)
    if dropped:  # Snakemake repeats no job while everything made from its output is there
        for made_from_runs in ("metrics", "tables", "report", "parts"):
            shutil.rmtree(folder / made_from_runs, ignore_errors=True)
    print(f"forgot {dropped} runs")


@app.command()
@user_errors
def baselines() -> None:
    """Every method: available or why not, version, what it certifies, citation."""
    from workflows.summary import print_baselines

    print_baselines()


@app.command()
@user_errors
def new_baseline(name: str) -> None:
    """Create ``baselines/NAME`` from the template."""
    from baselines import registry

    registry.new_baseline(name)
    print(registry.next_steps(name))


# --- the stages, as the rules call them --------------------------------------------------------


@app.command(hidden=True)
@user_errors
def plan(experiment: Experiment, out: Out, select: Select = None) -> None:
    """Write the table of planned runs."""
    from workflows import records
    from workflows.stages.plan import plan_table

    records.write(plan_table(_plan(experiment, select)), out)


@app.command(hidden=True)
@user_errors
def fetch(
    experiment: Experiment,
    chunk: Annotated[str, typer.Option()],
    out: Out,
    select: Select = None,
) -> None:
    """Fetch and verify the files that the instances of a chunk need."""
    from workflows.stages.fetch import fetch as fetch_files

    needed = _plan(experiment, select).chunk(chunk)
    fetch_files(needed, out)
    _say(f"fetch     {', '.join(needed.datasets)} for {chunk}")


@app.command(hidden=True)
@user_errors
def generate(
    experiment: Experiment,
    chunk: Annotated[str, typer.Option()],
    instances: Out,
    truth: Out,
    select: Select = None,
) -> None:
    """Make the instances of a chunk, and apart from them their truth."""
    from workflows.stages.generate import generate as generate_chunk

    specs = _plan(experiment, select).chunk(chunk)
    generate_chunk(specs, instances, truth)
    _say(f"generate  {chunk}: {len(specs.instances)} instances")


@app.command(hidden=True)
@user_errors
def solve(
    experiment: Experiment,
    method: Annotated[str, typer.Option()],
    instances: Out,
    out: Out,
    truth: Annotated[Path | None, typer.Option(help="For the oracle front end only.")] = None,
    select: Select = None,
) -> None:
    """Run a method on a chunk of instances."""
    # As an exception, so that workers and their children are ended too.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    from workflows.config import load
    from workflows.stages.solve import solve as solve_chunk

    settings = load(experiment)
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
    _say(f"evaluate  {len(metrics)} runs")


@app.command(hidden=True)
@user_errors
def aggregate(experiment: Experiment, folder: Folder, select: Select = None) -> None:
    """Write the tables."""
    from workflows.stages.aggregate import aggregate as join

    planned = _plan(experiment, select)
    join(planned, folder)
    _say(f"aggregate {folder / planned.view / 'tables'}")


@app.command(hidden=True)
@user_errors
def report(tables: Path, out: Path) -> None:
    """Build the HTML report."""
    from reports.build import build

    build(tables, out)
    _say(f"report    {out} ({out.stat().st_size / 1e6:.1f} MB)")


def _plan(experiment: str, select: list[str] | None = None) -> Plan:
    from workflows.config import load, origin, parse_selection
    from workflows.stages.plan import expand

    return expand(load(experiment), parse_selection(select or []), origin(experiment))


def _say(text: str) -> None:
    """A line of progress with the seconds that this process took."""
    print(f"{text}; {time.perf_counter() - BEGAN:.1f} s", flush=True)


def _stop(message: str) -> NoReturn:
    print(f"error: {message}", file=sys.stderr)
    raise typer.Exit(2)


if __name__ == "__main__":
    app()
