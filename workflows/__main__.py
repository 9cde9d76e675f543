"""Run the benchmark: ``python -m workflows``.

`workflows.stages.commands` has the hidden commands, which are the stages that the rules call. Modules are
imported inside the commands, so that each command loads only what it needs.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from dcreg.problem import suggestion
from dcreg.status import Status
from workflows import CHECKOUT, HISTORY, UserError, merge
from workflows.cli import ConfigOfRun, Experiment, Folder, RunId, Stored, say, stop, user_errors
from workflows.stages import commands
from workflows.stages.commands import planned

app = typer.Typer(
    help="Run the benchmark and compare its results.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Axis = Annotated[
    str,
    typer.Option(help="Names to include, comma-separated; default: all.", rich_help_panel="Part"),
]
History = Annotated[Path, typer.Option(help="Folder of the recorded versions.")]


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
    cores: Annotated[
        str, typer.Option(help="Number of cores, or all; with --profile: cores per job.")
    ] = "all",
    profile: Annotated[
        list[str] | None,
        typer.Option(help="slurm, kubernetes, or a folder with profile.yaml; may be repeated."),
    ] = None,
    directory: Annotated[Path, typer.Option(help="Folder that contains results/.")] = CHECKOUT,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan and run nothing.")
    ] = False,
    timing: Annotated[bool, typer.Option("--timing", help="Run one solve job at a time.")] = False,
    no_report: Annotated[bool, typer.Option("--no-report", help="Stop after the tables.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Reuse no archived runs.")] = False,
    beside: Annotated[
        bool,
        typer.Option("--beside", help="Run only --methods, on the instances of the archived runs."),
    ] = False,
) -> None:
    """Run an experiment, or a selected part of it, and print the summary.

    The tables and the report of a part are in results/NAME/parts; those of --beside are in
    results/NAME/evidence.
    """
    axes = {
        "methods": methods,
        "datasets": datasets,
        "shapes": shapes,
        "tests": tests,
        "levels": levels,
        "trials": trials,
    }
    if fresh:
        os.environ["DCREG_ARCHIVES"] = ""
    select = [f"{axis}={values}" for axis, values in axes.items() if values]
    if cores != "all" and not (cores.isdecimal() and int(cores)):
        raise UserError(f"--cores {cores}: give a positive number, or all")
    from workflows.blocks import chosen_trials
    from workflows.live import View
    from workflows.running import INTERRUPTED, cores_of_job, find_profile, run_snakemake
    from workflows.stages.plan import size_notes
    from workflows.stand_ins import fetchable

    profiles = [find_profile(each) for each in profile or ()]
    needs: list[str] = []
    if beside:
        if fresh or not methods or len(select) > 1:
            raise UserError(
                "--beside runs only your methods: give --methods, without --fresh or another selection"
            )
        path, select = _store_needs(experiment, methods.split(","), directory), []
        needs = [f"needs={path.resolve()}"]
        plan = planned(experiment, select, path)
    elif dry_run:
        plan = planned(experiment, select)
    else:
        experiment, select, plan = fetchable(experiment, select)
    name = plan.experiment.name
    folder = directory / "results" / name
    jobs = 1 if timing else os.cpu_count() or 1 if cores == "all" else int(cores)
    if plan.needs is None and not select and (note := chosen_trials(folder)):
        print(f"trials    {note}", flush=True)
    if dry_run:
        from workflows.summary import print_plan

        print_plan(plan, folder, jobs)
        return
    print(
        f"plan      {name}: {sum(len(chunk.instances) for _, chunk in plan.jobs())} runs of "
        f"{sum(len(chunk.instances) for chunk in plan.chunks)} instances "
        f"and {len(plan.methods)} methods",
        flush=True,
    )
    for note in size_notes(plan):
        print(f"points    {note}", flush=True)
    if Path(experiment).is_file():
        experiment = str(Path(experiment).resolve())
    if cores == "all" and any(each.is_remote for each in profiles):
        cores = cores_of_job(plan.experiment)
    arguments = [
        *(["tables"] if no_report else []),
        *("--cores", cores),
        *("--resources", "fetching=1", *(["timing=1"] if timing else [])),
        *("--config", f"experiment={experiment}", f"select={' '.join(select)}", *needs),
    ]
    if code := run_snakemake(
        directory, name, arguments, profiles, lambda: View(plan, folder, jobs), plan=plan
    ):
        what = "stopped" if code == INTERRUPTED else "some stages failed; see the messages above"
        print(
            f"error: {what}. Finished runs are kept; the same command continues from here.",
            file=sys.stderr,
        )
        raise typer.Exit(code)
    say("all stages")
    summary(folder / plan.view)


@app.command("snakemake-report")
@user_errors
def snakemake_report(
    experiment: Experiment,
    directory: Annotated[Path, typer.Option(help="Folder that contains results/.")] = CHECKOUT,
) -> None:
    """Write Snakemake's own report on a finished experiment: jobs, run times, results with captions."""
    from workflows.running import snakemake_report as write

    plan = planned(experiment)
    name = plan.experiment.name
    if Path(experiment).is_file():
        experiment = str(Path(experiment).resolve())
    out = directory / "results" / name / "snakemake-report.html"
    write(directory, name, [f"experiment={experiment}"], out)
    say(f"report    {out} ({out.stat().st_size / 1e6:.1f} MB)")


@app.command()
@user_errors
def summary(folder: Folder) -> None:
    """Print RMSE, success, time and certified share per method and test, and the path of the report."""
    from workflows.summary import print_summary

    print_summary(folder)


@app.command()
@user_errors
def record(
    results: Annotated[
        list[str], typer.Argument(help="Experiments that were run, or folders of results.")
    ],
    version: Annotated[str, typer.Option(help="Name of the version; default: from git.")] = "",
    history: History = HISTORY,
) -> None:
    """Record the results of experiments under a version name, for comparisons and the history page."""
    from workflows.recording import find
    from workflows.recording import record as store

    for folder in [find(result) for result in results]:
        out = store(folder, history, version)
        size = sum(path.stat().st_size for path in out.iterdir())
        print(f"recorded  {out} ({size / 1e3:.0f} kB)")


@app.command()
@user_errors
def compare(
    base: Annotated[
        str,
        typer.Argument(
            help="Recorded version, or folder of records or results; with --exact: folder of results."
        ),
    ] = "",
    head: Annotated[str, typer.Argument(help="The version or folder to compare with it.")] = "",
    exact: Annotated[
        bool,
        typer.Option("--exact", help="Compare run by run; only times may differ."),
    ] = False,
    times: Annotated[
        Path | None, typer.Option(help="Table of CPU times that `make timings` wrote.")
    ] = None,
    history: History = HISTORY,
    json_out: Annotated[
        Path | None, typer.Option("--json", help="File for the verdicts or the differences.")
    ] = None,
    text: Annotated[
        Path | None, typer.Option(help="File to which the verdicts are appended as Markdown.")
    ] = None,
) -> None:
    """Compare two sets of results: a verdict per metric or, with --exact, every difference.

    Exit code 0: no regression (--exact: all differences are explained); 1: otherwise; 2: not
    comparable, for example because a version is unknown.
    """
    if missing := [name for name, given in (("BASE", base), ("HEAD", head)) if not given]:
        from workflows.recording import versions

        known = ", ".join(versions(history)) or "none"
        raise UserError(
            f"{' and '.join(missing)} not given; use `make compare BASE=… HEAD=…` with recorded "
            f"versions ({known}), or folders of results"
        )
    if exact:
        for name, given in (("--times", times), ("--text", text)):
            if given:
                raise UserError(
                    f"{name}: needs verdicts, which --exact does not compute; omit one of the two"
                )
        from workflows.exact import differences, print_differences, read

        found = differences(read(Path(base)), read(Path(head)))
        print_differences(found)
        content, failed = found.cells.to_json(orient="records", indent=1), found.unexplained
    else:
        from workflows import verdict_text
        from workflows.compare import compare as verdicts_of
        from workflows.compare import regressed

        table = verdicts_of(base, head, history, times)
        verdict_text.print_verdicts(table, base, head)
        content, failed = verdict_text.as_json(table, base, head), regressed(table)
        if text:
            with text.open("a", encoding="utf-8") as stream:
                stream.write(verdict_text.markdown(table, base, head))
    if json_out:
        json_out.write_text(content, encoding="utf-8")
    raise typer.Exit(1 if failed else 0)


@app.command()
@user_errors
def versions(
    methods: Axis = "",
    accept: Annotated[
        bool,
        typer.Option(
            "--accept",
            help="Store methods that are new, or whose changed code gives the stored results.",
        ),
    ] = False,
    reviewed: Annotated[
        str,
        typer.Option(help="Methods to accept if they cannot be compared here, comma-separated."),
    ] = "",
) -> None:
    """Check that every method gives the results that are stored for its version."""
    from baselines import registry
    from workflows.versions import check

    names = methods.split(",") if methods else registry.names(registry.ROOT)
    unsettled = []
    for found in check(names, reviewed.split(","), accept=accept):
        print(f"{found.name:<16} {found.state}", flush=True)
        if not found.is_settled:
            unsettled.append(f"{found.name}: {found.state}: {found.remedy}")
    if unsettled:
        stop("\n".join(unsettled))


@app.command()
@user_errors
def replay(
    run_id: RunId,
    experiment: ConfigOfRun = "",
    results: Stored = Path("results"),
) -> None:
    """Repeat one run without the isolation of a worker process, and compare it with the stored one.

    The exit code is 1 if the results differ.
    """
    from workflows.replay import DIFFERENT
    from workflows.replay import replay as repeat

    found = repeat(run_id, experiment, results)
    print(json.dumps(found, indent=1))
    if found["stored"].startswith(DIFFERENT):
        raise typer.Exit(1)


@app.command()
@user_errors
def forget(
    folder: Folder,
    status: Annotated[str, typer.Option(help="Statuses, comma-separated.")] = "failed",
) -> None:
    """Delete runs with the given statuses, so that the next `run` repeats them.

    Archived runs are not deleted; `run --fresh` does not reuse them.
    """
    from workflows.running import remove_made_from_runs
    from workflows.stages.solve import forget as drop

    known = [str(each.value) for each in Status]
    for name in (statuses := set(status.split(","))):
        if name not in known:
            raise UserError(f"--status: no status {name!r}{suggestion(name, known)}")
    dropped = drop(folder / "runs", statuses)
    if dropped:
        remove_made_from_runs(folder)
    print(f"deleted {dropped} runs")


app.command("merge")(merge.command)


@app.command()
@user_errors
def baselines() -> None:
    """List every method: availability, version, what it certifies, citation."""
    from workflows.summary import print_baselines

    print_baselines()


@app.command()
@user_errors
def new_baseline(
    name: Annotated[str, typer.Argument(help="Name of the new method.")],
    folder: Annotated[Path, typer.Option("--in", help="Folder of methods.")] = CHECKOUT
    / "baselines",
) -> None:
    """Create the folder of a method from the template, in ``baselines/`` or elsewhere."""
    from baselines import template

    root = folder.expanduser().resolve()
    template.new_baseline(name, root)
    print(template.next_steps(name, root))


app.add_typer(commands.app)


def _store_needs(experiment: str, methods: list[str], directory: Path) -> Path:
    """Write the file of the archived blocks, extended by one's own methods; return its path."""
    from workflows.beside import needs_beside
    from workflows.blocks import EVIDENCE, NEEDS, Needs
    from workflows.config import with_methods

    plan = planned(experiment)
    plan = replace(plan, methods=tuple(with_methods(plan.experiment, methods).methods))
    path = directory / "results" / plan.experiment.name / EVIDENCE / NEEDS
    known = Needs.read(path) if path.is_file() else Needs({})
    needs_beside(plan, methods, known).write(path)
    return path


if __name__ == "__main__":
    app()
