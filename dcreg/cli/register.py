"""``dcreg register``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

import dcreg
from dcreg.cli import options
from dcreg.cli.inputs import parse_count, read_cloud, read_pairs
from dcreg.cli.output import (
    check_outputs,
    check_page,
    exit_on_bad_input,
    finish,
    print_tolerance_advice,
)
from dcreg.names import DEFAULT_TIME_LIMIT_S


def register(
    source: options.SourceArgument,
    target: options.TargetArgument,
    model: options.ModelOption,
    n_inliers: Annotated[
        str | None,
        typer.Option(
            metavar="K",
            help="Pairs to match: a count, or a fraction of the smaller cloud such as 0.8. "
            "A decimal point makes it a fraction: '1' is one pair, '1.0' is all of them. Required; "
            "`dcreg sweep` helps to choose it.",
        ),
    ] = None,
    scale_range: options.ScaleRangeOption = None,
    mode: options.ModeOption = None,
    bound: options.BoundOption = None,
    gap_tol: options.GapTolOption = None,
    tol: options.TolOption = None,
    time_limit: options.TimeLimitOption = DEFAULT_TIME_LIMIT_S,
    node_limit: options.NodeLimitOption = None,
    threads: options.ThreadsOption = 1,
    polish: options.PolishOption = True,
    downsample: options.DownsampleOption = None,
    candidates_path: options.CandidatesOption = None,
    source_key: options.SourceKeyOption = None,
    target_key: options.TargetKeyOption = None,
    json_path: options.JsonOption = None,
    trace_path: options.TraceOption = None,
    plot_path: options.PageOption = None,
    certificate_path: Annotated[
        Path | None,
        typer.Option("--certificate", metavar="OUT.npz", help="Write what `dcreg verify` checks."),
    ] = None,
    quiet: options.QuietOption = False,
) -> None:
    """Register SOURCE to TARGET and certify the result.

    Files: .txt .csv .xyz .npy .npz .mat .ply .pcd .off.

    Exit code: 0 solved; 2 bad input; 3 stopped at a limit or by Ctrl-C, best pose still written;
    1 an output file could not be written.
    """
    from dcreg.cli.progress import Progress

    with exit_on_bad_input():
        outputs = {
            "--json": json_path,
            "--trace": trace_path,
            "--plot": plot_path,
            "--certificate": certificate_path,
        }
        check_outputs(outputs, source, target, candidates_path, stdout="--json")
        check_page(plot_path)
        if n_inliers is None:
            raise dcreg.InputError(
                "--n-inliers: missing; give the number of pairs to match, such as 40 or 0.8, or let "
                "`dcreg sweep` suggest one"
            )
        points = read_cloud(source, source_key, model)
        problem = dcreg.Problem(
            points,
            read_cloud(target, target_key, model),
            parse_count(n_inliers),
            model.value,
            scale_range,
            read_pairs(candidates_path, len(points)),
        )
        if not quiet:
            print_tolerance_advice(gap_tol, tol)
        solve = dcreg.register  # loaded before signals are those of the search
        with Progress(gap_tol=gap_tol, quiet=quiet) as progress:
            result = progress.run(
                partial(
                    solve,
                    problem.source,
                    problem.target,
                    n_inliers=problem.n_inliers,
                    model=problem.model,
                    scale_range=scale_range,
                    gap_tol=gap_tol,
                    tol=tol,
                    time_limit=time_limit,
                    node_limit=node_limit,
                    candidates=problem.candidates,
                    options=dcreg.SolveOptions(
                        mode=mode,
                        bound=bound,
                        threads=threads,
                        polish=polish,
                        downsample=downsample,
                        certificate=certificate_path is not None,
                        listener=progress,
                    ),
                )
            )
    finish(
        result,
        (problem.source, problem.target),
        {"source": source, "target": target},
        json_path,
        [(trace_path, result.trace.write_jsonl), (certificate_path, result.write_certificate)],
        plot_path,
    )
