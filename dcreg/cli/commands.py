"""The commands that solve and verify."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import dcreg
from dcreg.cli import output
from dcreg.cli.app import app, command, run_search
from dcreg.cli.files import AnswerFiles, BatchFiles, Outputs, SearchFiles
from dcreg.cli.numbers import parse_count_or_auto, parse_counts
from dcreg.cli.options import CloudFiles, Goal, MatchSearch, Poses, Quiet, Search
from dcreg.cli.weights import CostFiles
from dcreg.names import FIGURE_PACKAGES, MAX_RMS_MET, SWEEP_TEXT

if TYPE_CHECKING:
    import numpy as np


def _finish(
    result: dcreg.Result,
    points: tuple[np.ndarray, np.ndarray],
    clouds: CloudFiles,
    outputs: Outputs,
    certificate_path: Path | None = None,
    **more: str,
) -> int:
    """Print a registration and write its files; the JSON has `more` keys."""
    json_path = outputs.json_path
    (in_files,) = clouds.in_files([result])
    names: dict[str, Any] = {**clouds.names, **more, **clouds.n_dropped}
    # standard output belongs to the JSON if that is written there
    to_stdout = json_path == output.STDOUT
    typer.echo(result, err=to_stdout)
    if to_stdout:
        typer.echo(in_files.to_json(**names))
        json_path = None
    shown = clouds.source, clouds.target
    return output.write_outputs(
        result.status,
        (json_path, partial(in_files.write_json, **names)),
        (outputs.trace_path, result.trace.write_jsonl),
        (certificate_path, result.write_certificate),
        (
            outputs.plot_path,
            lambda path: dcreg.plot_registration(*points, result, path, names=shown),
        ),
        (
            outputs.output_path,
            lambda path: dcreg.write_moved(
                clouds.source, result.T_target_source, path, key=clouds.source_key
            ),
        ),
    )


@command
def register(
    *,
    clouds: CloudFiles,
    goal: Goal,
    search: Search,
    poses: Poses,
    costs: CostFiles,
    outputs: Outputs,
    files: SearchFiles,
    quiet: Quiet = False,
) -> int:
    """Register SOURCE to TARGET and bound the global optimum.

    Files: .txt .csv .xyz .npy .npz .mat .ply .pcd .off .las .laz .e57.

    Exit code: 0 finished (optimal or converged); 2 bad input; 3 stopped at a limit or by Ctrl-C, or
    no answer to --max-rms (the best pose is still written); 4 an output file could not be written;
    6 refuted (it is proven that no pose fits as well as --max-rms).
    """
    paths = {**outputs.paths, **files.paths}
    read = search.candidates_path, poses.init, *costs.paths
    outputs.check(paths, *clouds.names.values(), *read)
    count = parse_count_or_auto(goal.n_inliers)
    points = clouds.read(search.model)
    keywords, options = search.settings(clouds)
    keywords |= costs.settings(clouds)
    options["certificate"] = files.certificate_path is not None
    options["checkpoint"] = files.checkpoint_path
    keywords["pose_range"], options["init"] = poses.settings()
    keywords |= {"n_inliers": count, "max_rms": goal.max_rms}
    result = run_search(dcreg.register, *points, quiet=quiet, options=options, **keywords)
    code = _finish(result, points, clouds, outputs, files.certificate_path)
    is_converged = result.status is dcreg.Status.CONVERGED
    is_open = goal.max_rms is not None and is_converged and result.reason != MAX_RMS_MET
    return code or (output.EXIT_LIMIT if is_open else output.EXIT_OK)


@command
def register_matches(
    *, clouds: CloudFiles, matches: str, search: MatchSearch, outputs: Outputs, quiet: Quiet = False
) -> int:
    """Register two 3D clouds from a list of matches, many of which may be wrong.

    The pose is rigid. Exit codes are those of `dcreg register`.

    Parameters
    ----------
    matches : MATCHES
        Matches, the most likely ones first: two columns, source row and target row, from 0.
    """
    outputs.check(outputs.paths, *clouds.names.values(), matches)
    points = clouds.read("rigid3d")
    pairs = clouds.read_matches(matches)
    result = run_search(
        dcreg.register_matches, *points, pairs, **vars(search), options={}, quiet=quiet
    )
    return _finish(result, points, clouds, outputs, matches=matches)


@command
def sweep(
    *,
    clouds: CloudFiles,
    n_inliers: str = SWEEP_TEXT,
    search: Search,
    poses: Poses,
    costs: CostFiles,
    out_path: Path | None = None,
    plot_path: Path | None = None,
    quiet: Quiet = False,
) -> int:
    """Register SOURCE to TARGET for several numbers of pairs and suggest one.

    For each number, the result has a pose and bounds, as in `dcreg register`.
    The time limit applies to all numbers together; the other limits apply to
    each search. Example:

    dcreg sweep a.txt b.txt --model similarity2d --n-inliers 0.5:1.0:0.05 --plot curves.html

    Exit code: 0 all finished (optimal or converged); 2 bad input; 3 some
    stopped at a limit or by Ctrl-C (their best poses and bounds are still
    written); 4 an output file could not be written.

    Parameters
    ----------
    n_inliers : LIST
        Numbers of pairs to match, separated by commas: counts, fractions of the smaller cloud, or ranges
        FROM:TO:STEP with both ends, such as 0.3:1.0:0.1 or 20:60:5.
    out_path : OUT
        Write the results: .json with poses and pairs, or .csv.
    plot_path : OUT
        Write the curves: .html, .png or .svg.
    """
    output.check_suffix("--out", out_path, [".json", ".csv"])
    output.check_figure(plot_path, list(FIGURE_PACKAGES))
    inputs = *clouds.names.values(), search.candidates_path, poses.init, *costs.paths
    output.check_outputs({"--out": out_path, "--plot": plot_path}, *inputs)
    counts = parse_counts(n_inliers)
    points = clouds.read(search.model)
    keywords, options = search.settings(clouds)
    keywords |= costs.settings(clouds)
    keywords["pose_range"], options["init"] = poses.settings()
    found = run_search(dcreg.sweep, *points, counts, quiet=quiet, options=options, **keywords)
    typer.echo(found)
    in_files = replace(found, results=clouds.in_files(found.results))
    write: output.Writer = partial(in_files.write_json, **clouds.names, **clouds.n_dropped)
    if out_path is not None and out_path.suffix.lower() == ".csv":
        write = found.write_csv
    names = clouds.source, clouds.target
    return output.write_outputs(
        found.status,
        (out_path, write),
        (plot_path, lambda path: dcreg.plot_sweep(found, path, names=names)),
    )


@command
def batch(
    *,
    pairs: Path,
    goal: Goal,
    search: Search,
    poses: Poses,
    drop_invalid: bool = False,
    files: BatchFiles,
    jobs: int = 1,
    quiet: Quiet = False,
) -> int:
    """Register each pair of a table or a folder and write a table of results.

    The same command continues after an interruption: pairs with the same files
    and options are not solved again, unless they failed.

    Exit code: 0 all finished; 2 bad input, or some pairs failed; 3 some stopped
    at a limit or without an answer to --max-rms, or Ctrl-C; 4 an output file
    could not be written.

    Parameters
    ----------
    pairs : PAIRS
        Table (.csv) with the columns source and target, files relative to its folder, and optionally
        n_inliers, which replaces --n-inliers. Or a folder with pairs.csv, else with files NAME_source and
        NAME_target, else with point files sorted by name: each is registered to the one before it.
    drop_invalid : switch
        Ignore points with NaN or infinity.
    jobs : N
        Number of processes.
    """
    from dcreg.cli.batch import Batch
    from dcreg.cli.folder import TABLE

    table = pairs / TABLE
    pairs = table if table.is_file() else pairs
    return Batch(pairs, search, poses, goal, drop_invalid).run(files, jobs, quiet)


@command
def verify(
    *,
    certificate: Path,
    clouds: CloudFiles,
    exact: bool = False,
    files: AnswerFiles,
    quiet: Quiet = False,
) -> int:
    """Check a certificate against its clouds, without the code of the search.

    The check can take several times as long as the search.

    Exit code: 0 the claim is proven, or true but trivial; 2 bad input; 4 an
    output file could not be written; 5 the certificate is rejected (the message
    states the reason).

    Parameters
    ----------
    certificate : CERT
        File written by --certificate.
    exact : switch
        Also prove both bounds in integer arithmetic, without rounding (model similarity2d only).
    """
    from dcreg.cli.progress import Progress

    files.check(*clouds.names.values(), str(certificate))
    points, check = clouds.read(), dcreg.verify
    with Progress(quiet=quiet, step="checking the statements of the certificate") as progress:
        report = progress.run(
            partial(check, certificate, *points, exact=exact, progress=progress.prove)
        )
    if not report.is_certificate:
        raise dcreg.InputError(report.reason)
    names: dict[str, Any] = {**clouds.names, "certificate": str(certificate), **clouds.n_dropped}
    code = output.write_answer(report, points, files.json_path, files.plot_path, names)
    return code or (output.EXIT_OK if report.accepted else output.EXIT_REFUSED)


@app.command()
def version() -> None:
    """Print the versions of dcreg, Python, NumPy, SciPy and Numba."""
    import platform
    from importlib.metadata import version as package_version

    typer.echo(f"dcreg {dcreg.__version__}")
    packages = ("numpy", "scipy", "numba")
    listing = ", ".join(f"{name} {package_version(name)}" for name in packages)
    typer.echo(f"python {platform.python_version()}, {listing}")
