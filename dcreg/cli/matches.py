"""``dcreg register-matches``."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

import dcreg
from dcreg.cli import options
from dcreg.cli.inputs import read_cloud
from dcreg.cli.output import (
    check_outputs,
    check_page,
    exit_on_bad_input,
    finish,
    print_tolerance_advice,
)
from dcreg.names import DEFAULT_TIME_LIMIT_S, JUDGES

MODEL = "rigid3d"


def register_matches(
    source: options.SourceArgument,
    target: options.TargetArgument,
    matches: Annotated[
        str,
        typer.Argument(
            metavar="MATCHES",
            help="Matches, the likely ones first: two columns, source row and target row, from 0.",
        ),
    ],
    inlier_distance: Annotated[
        float,
        typer.Option(
            metavar="D",
            parser=options.number,
            help="Residual from which on a match counts as wrong, in units of the target.",
        ),
    ],
    judge: Annotated[
        str,
        typer.Option(
            metavar="WHAT",
            help="What tells the right pose: 'matches', their cost; or 'surfaces', how far those of both "
            "clouds coincide, for dense scans, without bounds.",
        ),
    ] = JUDGES[0],
    certify: Annotated[
        bool | None,
        typer.Option(
            help="Branch and bound after the first pose, for bounds. Default: where matches judge.",
        ),
    ] = None,
    gap_tol: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            parser=options.number,
            help="Absolute gap to close, in squared units of the target. Default: D^2 / 10 for every "
            "match that the first pose chooses.",
        ),
    ] = None,
    time_limit: options.TimeLimitOption = DEFAULT_TIME_LIMIT_S,
    node_limit: options.NodeLimitOption = None,
    source_key: options.SourceKeyOption = None,
    target_key: options.TargetKeyOption = None,
    json_path: options.JsonOption = None,
    trace_path: options.TraceOption = None,
    plot_path: options.PageOption = None,
    quiet: options.QuietOption = False,
) -> None:
    """Register SOURCE to TARGET, clouds in space, over a list of matches of which many may be wrong.

    The pose is rigid. Exit code: as that of `dcreg register`.
    """
    from dcreg.cli.progress import Progress

    with exit_on_bad_input():
        outputs = {"--json": json_path, "--trace": trace_path, "--plot": plot_path}
        check_outputs(outputs, source, target, matches, stdout="--json")
        check_page(plot_path)
        clouds = (
            read_cloud(source, source_key, MODEL),
            read_cloud(target, target_key, MODEL),
        )
        pairs = dcreg.read_matches(matches, *map(len, clouds))
        if not quiet:
            print_tolerance_advice(gap_tol, None)
        solve = dcreg.register_matches  # loaded before signals are those of the search
        with Progress(gap_tol=gap_tol, quiet=quiet) as progress:
            result = progress.run(
                partial(
                    solve,
                    *clouds,
                    pairs,
                    inlier_distance=inlier_distance,
                    judge=judge,
                    certify=certify,
                    gap_tol=gap_tol,
                    time_limit=time_limit,
                    node_limit=node_limit,
                    options=dcreg.SolveOptions(listener=progress),
                )
            )
    finish(
        result,
        clouds,
        {"source": source, "target": target, "matches": matches},
        json_path,
        [(trace_path, result.trace.write_jsonl)],
        plot_path,
    )
