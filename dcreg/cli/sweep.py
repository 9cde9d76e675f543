"""``dcreg sweep``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

import dcreg
from dcreg.cli import options
from dcreg.cli.inputs import parse_counts, read_cloud, read_pairs
from dcreg.cli.output import (
    Writer,
    check_outputs,
    check_packages,
    check_suffix,
    exit_code,
    exit_on_bad_input,
    print_tolerance_advice,
    write_outputs,
)
from dcreg.names import DEFAULT_TIME_LIMIT_S, FIGURE_PACKAGES


def sweep(
    source: options.SourceArgument,
    target: options.TargetArgument,
    model: options.ModelOption,
    n_inliers: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Pairs to match: counts or fractions of the smaller cloud joined by ',', or ranges "
            "FROM:TO:STEP with both ends, such as 0.3:1.0:0.1 or 20:60:5.",
        ),
    ],
    scale_range: options.ScaleRangeOption = None,
    mode: options.ModeOption = None,
    bound: options.BoundOption = None,
    gap_tol: options.GapTolOption = None,
    tol: options.TolOption = None,
    time_limit: Annotated[
        float,
        typer.Option(
            metavar="S",
            parser=options.number,
            help="Seconds for all cardinalities together; inf: no limit.",
        ),
    ] = DEFAULT_TIME_LIMIT_S,
    node_limit: options.NodeLimitOption = None,
    threads: options.ThreadsOption = 1,
    polish: options.PolishOption = True,
    downsample: options.DownsampleOption = None,
    candidates_path: options.CandidatesOption = None,
    source_key: options.SourceKeyOption = None,
    target_key: options.TargetKeyOption = None,
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="OUT", help="Write the results: .json with poses and pairs, or .csv."
        ),
    ] = None,
    plot_path: Annotated[
        Path | None,
        typer.Option("--plot", metavar="OUT", help="Write the curves: .html, .png or .svg."),
    ] = None,
    quiet: options.QuietOption = False,
) -> None:
    """Register SOURCE to TARGET for several numbers of inliers, to choose one.

    Every cardinality gets its optimum with bounds, as of `dcreg register`; one search
    serves several cardinalities where its bounds allow it. Example:

    dcreg sweep a.txt b.txt --model similarity2d --n-inliers 0.5:1.0:0.05 --plot curves.html

    Exit code: 0 all solved; 2 bad input; 3 some stopped at a limit or by Ctrl-C, their best poses and
    bounds still written; 1 an output file could not be written.
    """
    from dcreg.cli.progress import Progress

    with exit_on_bad_input():
        check_suffix("--out", out_path, [".json", ".csv"])
        check_suffix("--plot", plot_path, list(FIGURE_PACKAGES))
        if plot_path is not None:
            check_packages(plot_path, plot_path.suffix.lower())
        check_outputs({"--out": out_path, "--plot": plot_path}, source, target, candidates_path)
        counts = parse_counts(n_inliers)
        points = read_cloud(source, source_key, model)
        target_points = read_cloud(target, target_key, model)
        candidates = read_pairs(candidates_path, len(points))
        if not quiet:
            print_tolerance_advice(gap_tol, tol)
        solve = dcreg.sweep  # loaded before signals are those of the search
        with Progress(gap_tol=gap_tol, quiet=quiet) as progress:
            found = progress.run(
                partial(
                    solve,
                    points,
                    target_points,
                    counts,
                    model=model.value,
                    scale_range=scale_range,
                    gap_tol=gap_tol,
                    tol=tol,
                    time_limit=time_limit,
                    node_limit=node_limit,
                    candidates=candidates,
                    options=dcreg.SolveOptions(
                        mode=mode,
                        bound=bound,
                        threads=threads,
                        polish=polish,
                        downsample=downsample,
                        listener=progress,
                    ),
                )
            )
    typer.echo(found)
    complete = write_outputs(
        [
            (out_path, _writer(found, out_path, source=source, target=target)),
            (plot_path, lambda path: dcreg.plot_sweep(found, path, names=(source, target))),
        ]
    )
    raise typer.Exit(exit_code(found.status, complete))


def _writer(found: dcreg.SweepResult, path: Path | None, **files: str) -> Writer:
    if path is not None and path.suffix.lower() == ".csv":
        return found.write_csv
    return lambda path: found.write_json(path, **files)
