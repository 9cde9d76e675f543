"""Build the pages that show results: ``python -m reports``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from workflows import CHECKOUT, HISTORY
from workflows.cli import ConfigOfRun, Experiment, RunId, Stored, say, user_errors

app = typer.Typer(
    help="Build the pages that show results.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Part = Annotated[str, typer.Option(help="Names to include, comma-separated; default: all.")]


@app.command()
@user_errors
def experiment(
    tables: Annotated[Path, typer.Argument(help="Folder with the tables of an experiment.")],
    out: Annotated[Path, typer.Argument(help="HTML file to write.")],
) -> None:
    """Build the report of one experiment."""
    from reports.build import build

    build(tables, out)
    say(f"report    {out} ({out.stat().st_size / 1e6:.1f} MB)")


@app.command()
@user_errors
def boxes(
    run_id: RunId,
    experiment: ConfigOfRun = "",
    results: Stored = Path("results"),
    out: Annotated[Path, typer.Option(help="Folder for the page.")] = Path("results/boxes"),
) -> None:
    """Repeat a run of DC-Reg, compare it with the stored one, and draw the boxes of its search.

    The exit code is 1 if the results differ.
    """
    from reports.boxes import repeat
    from workflows.replay import DIFFERENT

    page, result = repeat(run_id, experiment, results, out)
    say(f"stored    {result['stored']}")
    say(f"boxes     {page}")
    if result["stored"].startswith(DIFFERENT):
        raise typer.Exit(1)


@app.command()
@user_errors
def tables(
    tables: Annotated[Path, typer.Argument(help="Folder with the tables of an experiment.")],
    out: Annotated[Path, typer.Argument(help="Folder for the CSV files.")],
) -> None:
    """Write the result tables of a report as CSV files."""
    from reports.csv_tables import write

    say(f"tables    {len(write(tables, out))} files in {out}")


@app.command()
@user_errors
def claims(
    results: Annotated[
        list[Path] | None,
        typer.Argument(help="Folders of results, or folders that contain them; default: results."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the table and the page.")] = Path(
        "results/claims"
    ),
    before: Annotated[
        Path | None,
        typer.Option(help="claims.csv of an earlier check; the verdicts that changed are printed."),
    ] = None,
) -> None:
    """Check the claims of the paper against the available results."""
    from reports.claims import check

    check(results or [Path("results")], out, before)


Folders = Annotated[
    list[Path] | None, typer.Argument(help="Folders that contain results; default: results.")
]


@app.command()
@user_errors
def figures(
    results: Folders = None,
    out: Annotated[Path, typer.Option(help="Folder for the page and the files for print.")] = Path(
        "results/figures"
    ),
) -> None:
    """Draw all figures of the paper for print, and write a page that shows them."""
    from reports.paper_page import build

    say(f"figures   {build(out, results or [Path('results')])}")


@app.command()
@user_errors
def figure(
    name: Annotated[
        str,
        typer.Argument(help="Name of a module of reports/figures/standalone, such as paper_2d."),
    ],
    tables: Annotated[
        Path | None, typer.Option(help="Folder with tables; default: those found in results/.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for SVG, PDF and page.")] = Path(
        "results/figures"
    ),
) -> None:
    """Draw one figure of the paper."""
    from reports.paper_page import build

    say(f"figure    {build(out, names=[name], tables=tables)}")


@app.command()
@user_errors
def findings(
    archive: Annotated[
        str,
        typer.Argument(help="Stored version; default: the latest with runs of `findings`."),
    ] = "",
) -> None:
    """Write docs/findings.md from an archive."""
    from reports import findings as page
    from workflows.archives import ARCHIVES

    say(f"findings  {page.write(ARCHIVES / archive if archive else page.archive_of_findings())}")


@app.command()
@user_errors
def evidence(
    hours: Annotated[
        float, typer.Option(help="Hours to spend; 0: only show what open claims need.", min=0.0)
    ] = 2.0,
    experiments: Annotated[
        str, typer.Option(help="Experiments, comma-separated.")
    ] = "paper2d-40,paper3d-40",
    cores: Annotated[int, typer.Option(help="Number of cores.", min=1)] = 2,
    directory: Annotated[Path, typer.Option(help="Folder that contains results/.")] = CHECKOUT,
) -> None:
    """Spend the given hours on the runs that decide claims soonest; the same command continues."""
    from reports.campaign.run import collect
    from workflows.config import load
    from workflows.running import set_aside

    names = experiments.split(",")
    for name in names if hours else ():
        set_aside(directory, load(name).name)
    collect(hours, names, directory, cores, directory / "results" / "evidence")


@app.command()
@user_errors
def archive(
    results: Folders = None,
    version: Annotated[
        str, typer.Option(help="Name of the archive; default: the version of dcreg.")
    ] = "",
    publish: Annotated[
        bool,
        typer.Option("--publish", help="Write a zip file to results/published instead."),
    ] = False,
    replace: Annotated[
        bool,
        typer.Option("--replace", help="Replace results of an earlier archive by fewer ones."),
    ] = False,
) -> None:
    """Write all results to reports/archive/VERSION, which is part of the repository.

    An archive also contains the configs and the code of your own methods and datasets.
    """
    from dcreg import __version__
    from reports.archive import crate, read
    from reports.archive.write import write
    from workflows.archives import ARCHIVES

    name = version or __version__
    place = Path("results", "published") if publish else ARCHIVES
    folder = write(
        results or [Path("results")],
        place / name,
        name,
        replace=replace or publish,
        keep=not publish,
    )
    read.check(folder)
    crate.check(folder)
    size = sum(path.stat().st_size for path in folder.rglob("*"))
    say(f"archive   {folder} ({size / 1e6:.1f} MB)")
    if publish:
        from reports.archive.sources import missing_code
        from reports.archive.write import pack
        from workflows.integrity import digest

        for line in missing_code(folder):
            say(f"warning   {line}")
        path = pack(folder)
        print(
            f"publish   {path}\n"
            "          upload the file to a permanent address, and publish this command:\n"
            f"          make report ARCHIVE=<address> SHA256={digest(path)}"
        )


@app.command()
@user_errors
def archived(
    archive: Annotated[
        str,
        typer.Argument(help="A stored version, a folder, a zip file, or the URL of a zip file."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the pages; default: results/archive/ARCHIVE.")
    ] = None,
    sha256: Annotated[str, typer.Option(help="SHA-256 of the zip file at a URL.")] = "",
) -> None:
    """Build all pages from an archive; nothing is run."""
    from reports.archive.pages import build
    from reports.archive.read import name_of

    say(f"pages     {build(archive, out or Path('results/archive', name_of(archive)), sha256)}")


@app.command()
@user_errors
def history(
    out: Annotated[Path, typer.Option(help="Folder for the page.")] = Path("results/history"),
    records: Annotated[Path, typer.Option(help="Folder of the recorded versions.")] = HISTORY,
) -> None:
    """Draw the results of all recorded versions, and mark what changed between them."""
    from reports.history.page import build

    say(f"history   {build(out, records)}")


@app.command()
@user_errors
def bounds(
    folder: Annotated[Path, typer.Argument(help="Folder with the tables of the study.")] = Path(
        "results/bounds"
    ),
) -> None:
    """Build the page of the study of bounds (`python -m workflows.studies.bounds`)."""
    from reports.bounds_study import build

    page = build(folder)
    typer.echo(f"{page} ({page.stat().st_size / 1e6:.1f} MB)")


@app.command()
@user_errors
def library(
    out: Annotated[Path, typer.Option(help="Folder for the page and its table.")] = Path(
        "results/library/page"
    ),
) -> None:
    """Build the page of the problem library."""
    from reports.library.page import build

    say(f"library   {build(out)}")


@app.command()
@user_errors
def threedmatch(
    experiment: Experiment = "threedmatch",
    methods: Part = "",
    datasets: Part = "",
    tests: Part = "",
    directory: Annotated[Path, typer.Option(help="Folder that contains results/.")] = CHECKOUT,
) -> None:
    """Write the recalls of an experiment on the official 3DMatch lists, and a figure of errors."""
    from reports.threedmatch import write
    from workflows.config import load, parse_selection
    from workflows.stages.plan import expand

    axes = {"methods": methods, "datasets": datasets, "tests": tests}
    select = [f"{axis}={values}" for axis, values in axes.items() if values]
    plan = expand(load(experiment), parse_selection(select))
    write(directory / "results" / plan.experiment.name / plan.view / "tables")


if __name__ == "__main__":
    app()
