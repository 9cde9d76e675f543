"""Command line of dcreg: register two point clouds, with the certificate in plain words."""

from __future__ import annotations

import csv
import json
import math
import os
import platform
import tempfile
from collections.abc import Callable, Iterator
from enum import StrEnum
from functools import partial
from importlib.metadata import version as package_version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

import dcreg
from dcreg._version import __version__
from dcreg.bounds import bound_names
from dcreg.certificate import write as write_certificate
from dcreg.certificate.verification import verify as verify_certificate
from dcreg.io import read_points
from dcreg.modes import AUTO, mode_names
from dcreg.plot import SWEEP_IMAGES, SWEEP_PAGE, plot_registration, plot_sweep
from dcreg.problem import MODEL_DIM, InputError, Problem, default_gap_tol, rms_radius
from dcreg.progress import Progress
from dcreg.result import Result
from dcreg.status import Status
from dcreg.sweep_result import SweepResult

EXIT_OK, EXIT_OUTPUT, EXIT_INPUT, EXIT_LIMIT = 0, 1, 2, 3
_MANY_POINTS = 4000
_MAX_SWEEP = 1000
_STDOUT = Path("-")
_OPTION_FIELDS = {"model", "n_inliers", "scale_range", "mode", "bound", "gap_tol", "threads"}
_OPTION_FIELDS |= {"time_limit", "node_limit"}

Writer = Callable[[Path], object]

app = typer.Typer(
    name="dcreg",
    help="Globally optimal point cloud registration by branch and bound.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


class ModelChoice(StrEnum):
    """Kinds of pose."""

    SIMILARITY2D = "similarity2d"
    RIGID3D = "rigid3d"


# Typer's own conversions name the option but not the value.
def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not a number; give one such as 0.5") from None


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not a whole number; give one such as 4") from None


# --- options that several commands have -----------------------------------------------------------

SourceArgument = Annotated[
    str, typer.Argument(metavar="SOURCE", help="Cloud to move; FILE or FILE.npz:KEY.")
]
TargetArgument = Annotated[
    str,
    typer.Argument(metavar="TARGET", help="Cloud that stays; its units are used throughout."),
]
ModelOption = Annotated[
    ModelChoice, typer.Option(metavar="NAME", help="Kind of pose: similarity2d or rigid3d.")
]
ScaleRangeOption = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="LO HI", parser=_number, help="Admissible scale (2D only)."),
]
BoundOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"Lower bounding function: {', '.join(bound_names())}; 'a+b' takes the greater.",
    ),
]
GapTolOption = Annotated[
    float | None,
    typer.Option(
        metavar="X",
        parser=_number,
        help="Absolute gap to close, in the objective's units (sum of squared residuals of the "
        "K pairs). Default: K * (0.03 * RMS radius of the target)^2.",
    ),
]
TimeLimitOption = Annotated[
    float | None, typer.Option(metavar="S", parser=_number, help="Seconds of search.")
]
NodeLimitOption = Annotated[
    int | None, typer.Option(metavar="N", parser=_whole, help="Boxes to bound.")
]
ThreadsOption = Annotated[int, typer.Option(metavar="N", parser=_whole, help="Threads.")]
PolishOption = Annotated[
    bool, typer.Option(help="Refine pose and pairs jointly after the certified search.")
]
CandidatesOption = Annotated[
    str | None,
    typer.Option(
        "--candidates",
        metavar="FILE",
        help="Feasible pairs: two columns, source row and target row, from 0. Default: all.",
    ),
]
SourceKeyOption = Annotated[
    str | None, typer.Option(metavar="KEY", help="Array of an .npz or .mat source.")
]
TargetKeyOption = Annotated[
    str | None, typer.Option(metavar="KEY", help="Array of an .npz or .mat target.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no advice.")]


@app.callback()
def main() -> None:
    """Globally optimal point cloud registration by branch and bound."""


@app.command()
def version() -> None:
    """Print the versions that decide a result."""
    typer.echo(f"dcreg {__version__}")
    packages = ("numpy", "scipy", "numba")
    listing = ", ".join(f"{name} {package_version(name)}" for name in packages)
    typer.echo(f"python {platform.python_version()}, {listing}")


@app.command()
def register(
    source: SourceArgument,
    target: TargetArgument,
    model: ModelOption,
    n_inliers: Annotated[
        str,
        typer.Option(
            metavar="K",
            help="Pairs to match: a count, or a fraction of the smaller cloud such as 0.8. "
            "A decimal point makes it a fraction: '1' is one pair, '1.0' is all of them.",
        ),
    ],
    scale_range: ScaleRangeOption = None,
    mode: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Search mode; default: {AUTO}. In 2D paper; in 3D one of "
            f"{', '.join(mode_names('rigid3d'))}: {AUTO} takes full where all points match or there are "
            "few, else multi; paper for very many, and with --bound or --certificate.",
        ),
    ] = None,
    bound: BoundOption = None,
    gap_tol: GapTolOption = None,
    time_limit: TimeLimitOption = None,
    node_limit: NodeLimitOption = None,
    threads: ThreadsOption = 1,
    polish: PolishOption = True,
    candidates_path: CandidatesOption = None,
    source_key: SourceKeyOption = None,
    target_key: TargetKeyOption = None,
    json_path: Annotated[
        Path | None,
        typer.Option("--json", metavar="OUT", help="Write the result; '-' is standard output."),
    ] = None,
    trace_path: Annotated[
        Path | None,
        typer.Option("--trace", metavar="OUT.jsonl", help="Write the bound history."),
    ] = None,
    plot_path: Annotated[
        Path | None, typer.Option("--plot", metavar="OUT.html", help="Write a page with figures.")
    ] = None,
    certificate_path: Annotated[
        Path | None,
        typer.Option("--certificate", metavar="OUT.npz", help="Write what `dcreg verify` checks."),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Register SOURCE to TARGET and certify the result.

    Files: .txt .csv .xyz .npy .npz .mat .ply .pcd .off.

    Exit code: 0 solved; 2 bad input; 3 stopped at a limit or by Ctrl-C, best pose still written;
    1 an output file could not be written.
    """
    log = Console(stderr=True)
    try:
        outputs = {
            "--json": json_path,
            "--trace": trace_path,
            "--plot": plot_path,
            "--certificate": certificate_path,
        }
        inputs = (source, target) if candidates_path is None else (source, target, candidates_path)
        _check_outputs(outputs, inputs)
        problem = _problem(
            (source, source_key),
            (target, target_key),
            model.value,
            n_inliers,
            scale_range,
            candidates_path,
        )
        if not quiet:
            for line in _advice(problem):
                log.print(line, style="yellow", highlight=False, soft_wrap=True)
        if gap_tol is None:
            gap_tol = default_gap_tol(problem.source, problem.target, problem.n_inliers)
        with Progress(log, gap_tol=gap_tol, quiet=quiet) as progress:
            result = dcreg.register(
                problem.source,
                problem.target,
                n_inliers=problem.n_inliers,
                model=problem.model,
                mode=mode,
                bound=bound,
                scale_range=scale_range,
                gap_tol=gap_tol,
                time_limit=time_limit,
                node_limit=node_limit,
                threads=threads,
                candidates=problem.candidates,
                polish=polish,
                certificate=certificate_path is not None,
                listener=progress,
            )
    except InputError as error:
        _print_error(log, _with_option_names(str(error)))
        raise typer.Exit(EXIT_INPUT) from None
    # Standard output belongs to the JSON when it goes there.
    _print_summary(log if json_path == _STDOUT else Console(), result)
    document = _document(result, source=source, target=target)
    if json_path == _STDOUT:
        typer.echo(document)
        json_path = None
    writers: list[tuple[Path | None, Writer]] = [
        (json_path, lambda part: part.write_text(document + "\n", encoding="utf-8")),
        (trace_path, result.trace.write_jsonl),
        (plot_path, partial(plot_registration, problem.source, problem.target, result)),
    ]
    if result.certificate is not None:
        writers.append(
            (certificate_path, partial(write_certificate, certificate=result.certificate))
        )
    if not _write_outputs(log, writers):
        raise typer.Exit(EXIT_OUTPUT)
    raise typer.Exit(_exit_code(result.status))


@app.command()
def sweep(
    source: SourceArgument,
    target: TargetArgument,
    model: ModelOption,
    n_inliers: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Pairs to match: counts or fractions of the smaller cloud joined by ',', or ranges "
            "FROM:TO:STEP with both ends, such as 0.3:1.0:0.1 or 20:60:5.",
        ),
    ],
    scale_range: ScaleRangeOption = None,
    bound: BoundOption = None,
    gap_tol: GapTolOption = None,
    time_limit: Annotated[
        float | None,
        typer.Option(metavar="S", parser=_number, help="Seconds for all cardinalities together."),
    ] = None,
    node_limit: NodeLimitOption = None,
    threads: ThreadsOption = 1,
    polish: PolishOption = True,
    candidates_path: CandidatesOption = None,
    source_key: SourceKeyOption = None,
    target_key: TargetKeyOption = None,
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
    quiet: QuietOption = False,
) -> None:
    """Register SOURCE to TARGET for several numbers of inliers, to choose one.

    Every cardinality gets its optimum with bounds, as of `dcreg register` in mode paper; one search
    serves several cardinalities where its bounds allow it. Example:

    dcreg sweep a.txt b.txt --model similarity2d --n-inliers 0.5:1.0:0.05 --plot curves.html

    Exit code: 0 all solved; 2 bad input; 3 some stopped at a limit or by Ctrl-C, their best poses and
    bounds still written; 1 an output file could not be written.
    """
    log = Console(stderr=True)
    try:
        _check_suffix("--out", out_path, tuple(_SWEEP_WRITERS))
        _check_suffix("--plot", plot_path, (SWEEP_PAGE, *SWEEP_IMAGES))
        _check_images(plot_path)
        inputs = (source, target) if candidates_path is None else (source, target, candidates_path)
        _check_outputs({"--out": out_path, "--plot": plot_path}, inputs=inputs)
        counts = _counts(n_inliers)
        problem = _problem(
            (source, source_key), (target, target_key), model.value, "1.0", scale_range
        )
        candidates = None
        if candidates_path is not None:  # enough for which counts, `dcreg.sweep` finds out
            candidates = _candidates(candidates_path, len(problem.source))
        if not quiet:
            for line in _advice(problem):
                log.print(line, style="yellow", highlight=False, soft_wrap=True)
        with Progress(log, gap_tol=gap_tol, quiet=quiet) as progress:
            found = dcreg.sweep(
                problem.source,
                problem.target,
                counts,
                model=problem.model,
                bound=bound,
                scale_range=scale_range,
                gap_tol=gap_tol,
                time_limit=time_limit,
                node_limit=node_limit,
                threads=threads,
                candidates=candidates,
                polish=polish,
                listener=progress,
            )
    except InputError as error:
        _print_error(log, _with_option_names(str(error)))
        raise typer.Exit(EXIT_INPUT) from None
    _print_sweep(Console(), found)
    writers: list[tuple[Path | None, Writer]] = []
    if out_path is not None:
        write = _SWEEP_WRITERS[out_path.suffix.lower()]
        writers.append((out_path, partial(write, found, source=source, target=target)))
    if plot_path is not None:
        writers.append((plot_path, partial(plot_sweep, found, kind=plot_path.suffix.lower())))
    if not _write_outputs(log, writers):
        raise typer.Exit(EXIT_OUTPUT)
    raise typer.Exit(_exit_code(found.status))


@app.command()
def verify(
    certificate: Annotated[Path, typer.Argument(metavar="CERT", help="File of --certificate.")],
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="The cloud that was moved.")],
    target: Annotated[str, typer.Argument(metavar="TARGET", help="The cloud that stayed.")],
) -> None:
    """Check a certificate against its clouds, in plain NumPy, without the search.

    Exit code: 0 the claim is proven; 1 refused, with the reason; 2 bad input.
    """
    log = Console(stderr=True)
    try:
        if not certificate.is_file():
            raise InputError(
                f"{certificate}: no such file; `dcreg register --certificate` writes one"
            )
        report = verify_certificate(certificate, read_points(source), read_points(target))
    except InputError as error:
        _print_error(log, str(error))
        raise typer.Exit(EXIT_INPUT) from None
    for check in report.checks:
        typer.echo(f"ok: {check}")
    typer.echo(f"proven: {report.statement}" if report.accepted else f"refused: {report.reason}")
    raise typer.Exit(0 if report.accepted else 1)


# --- input ----------------------------------------------------------------------------------------


def _problem(
    source: tuple[str, str | None],
    target: tuple[str, str | None],
    model: str,
    n_inliers: str,
    scale_range: tuple[float, float] | None,
    candidates: str | None = None,
) -> Problem:
    clouds = [_cloud(path, key, model) for path, key in (source, target)]
    feasible = None if candidates is None else _candidates(candidates, len(clouds[0]))
    return Problem(clouds[0], clouds[1], _count(n_inliers), model, scale_range, feasible)


def _candidates(path: str, n: int) -> list[list[int]]:
    """Target rows per source row, from a table of pairs."""
    pairs = read_points(path)
    if pairs.shape[1] != 2 or (pairs != np.round(pairs)).any():
        raise InputError(f"{path}: not a table of pairs; give two columns of row numbers, from 0")
    out: list[list[int]] = [[] for _ in range(n)]
    for i, j in pairs.astype(int).tolist():
        if not 0 <= i < n:
            raise InputError(f"{path}: {i} is no source row; use rows from 0 to {n - 1}")
        out[i].append(j)
    return out


def _cloud(path: str, key: str | None, model: str) -> np.ndarray:
    points = read_points(path, key=key)
    needed, found = MODEL_DIM[model], points.shape[1]
    if found != needed:
        fitting = next(name for name, dim in MODEL_DIM.items() if dim == found)
        raise InputError(
            f"{path}: points have {found} coordinates, but --model {model} needs {needed}; "
            f"use --model {fitting} or another file"
        )
    return points


def _count(text: str) -> int | float:
    """`--n-inliers`: an integer is a count, anything with a decimal point a fraction."""
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"--n-inliers: '{text}' is not a number; give a count such as 40 or a fraction "
            "such as 0.8"
        ) from None


def _counts(text: str) -> list[int | float]:
    """`--n-inliers` of a sweep: numbers and ranges ``FROM:TO:STEP``, joined by commas."""
    counts: list[int | float] = []
    for part in filter(None, (part.strip() for part in text.split(","))):
        counts += _range(part) if ":" in part else [_count(part)]
    return counts


def _range(text: str) -> list[int | float]:
    first, last, *rest = ends = [_count(number) for number in text.split(":")]
    if len({type(number) for number in ends}) > 1:
        raise InputError(
            f"--n-inliers: '{text}' mixes counts and fractions; a fraction needs a decimal point, "
            "as in 0.3:1.0:0.1"
        )
    if not rest and isinstance(first, int):
        rest = [1]
    if len(rest) != 1 or not all(map(math.isfinite, ends)) or rest[0] <= 0 or first > last:
        raise InputError(
            f"--n-inliers: '{text}' is not a range FROM:TO:STEP with FROM <= TO and STEP > 0; "
            "give one such as 0.3:1.0:0.1 or 20:60:5"
        )
    step = rest[0]
    n_steps = math.floor((last - first) / step + 1e-9)  # 0.7 / 0.1 is a little less than 7
    if n_steps >= _MAX_SWEEP:
        raise InputError(
            f"--n-inliers: '{text}' names {n_steps + 1} cardinalities; choose a step that leaves at "
            f"most {_MAX_SWEEP}"
        )
    if isinstance(first, int):
        return [first + at * step for at in range(n_steps + 1)]
    return [round(first + at * step, 12) for at in range(n_steps + 1)]


def _with_option_names(message: str) -> str:
    """The library speaks of fields; on the command line these are options or arguments."""
    field, colon, rest = message.partition(":")
    option = "--" + field.replace("_", "-")
    return option + colon + rest if field in _OPTION_FIELDS else message


def _advice(problem: Problem) -> Iterator[str]:
    """Warnings on what most often goes wrong with one's own clouds."""
    n, m = len(problem.source), len(problem.target)
    if max(n, m) > _MANY_POINTS:
        work = float(problem.n_inliers) * n * m
        yield (
            f"warning: {n} x {m} points. Each exact assignment takes {_bytes(8.0 * n * m)} and up "
            f"to K n m = {work:.0e} operations (at worst about {_duration(work / 1e9)}), and a "
            "search takes hundreds of them. Downsample both clouds to some hundred points first "
            "(voxel grid or every k-th point) and scale a counted K with them."
        )
    radii = rms_radius(problem.source), rms_radius(problem.target)
    ratio = radii[0] / radii[1] if radii[1] > 0 else math.inf
    if problem.model == "rigid3d" and not 0.5 <= ratio <= 2.0:
        yield (
            f"hint: the RMS radii differ a lot (source {radii[0]:.4g}, target {radii[1]:.4g}), and "
            "rigid3d has no scale. If the units differ, rescale one cloud; for two views that "
            "overlap in part this may be all right."
        )


def _bytes(count: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def _duration(seconds: float) -> str:
    for unit, size in (("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"


# --- output ---------------------------------------------------------------------------------------


def _check_outputs(outputs: dict[str, Path | None], inputs: tuple[str, ...]) -> None:
    """Fail before the search if a result could not be written after it."""
    taken: dict[Path, str] = {Path(name).resolve(): "an input" for name in inputs}
    for option, path in outputs.items():
        if path is None or (path == _STDOUT and option == "--json"):
            continue
        if path.exists() and not path.is_file():
            raise InputError(f"{option} {path}: exists and is not a plain file; name another file")
        if (use := taken.get(path.resolve())) is not None:
            raise InputError(f"{option} {path}: is {use} as well; name another file")
        taken[path.resolve()] = f"the file of {option}"
        if not path.parent.is_dir():
            raise InputError(f"{option} {path}: no folder '{path.parent}'; create it first")
        try:
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        except OSError as error:
            raise InputError(
                f"{option} {path}: cannot write in '{path.parent}' ({error.strerror}); "
                "name a file elsewhere"
            ) from None


def _check_suffix(option: str, path: Path | None, known: tuple[str, ...]) -> None:
    if path is not None and path.suffix.lower() not in known:
        raise InputError(f"{option} {path}: the name must end in one of {', '.join(known)}")


def _check_images(path: Path | None) -> None:
    if path is None or path.suffix.lower() not in SWEEP_IMAGES:
        return
    missing = [name for name in ("matplotlib", "seaborn") if find_spec(name) is None]
    if missing:
        raise InputError(
            f"--plot {path}: images need {' and '.join(missing)}; install them or name an .html file"
        )


def _write_outputs(log: Console, writers: list[tuple[Path | None, Writer]]) -> bool:
    """Write each file that was asked for; False if one could not be written."""
    complete = True
    for path, write in writers:
        if path is None:
            continue
        # A neighbour takes the place of `path` when all is written, so that no half file stays.
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            write(part)
            part.replace(path)
        except OSError as error:
            complete = False
            _print_error(
                log,
                f"cannot write {path}: {error.strerror or error}; the result is printed above, "
                "free some space or name a file elsewhere",
            )
        finally:
            part.unlink(missing_ok=True)
    return complete


def _document(result: Result, **files: str) -> str:
    """The result as JSON. A bound that does not exist (infinite) becomes null."""
    content = {**result.to_dict(), **files, "dcreg_version": __version__}
    return json.dumps(_plain(content), indent=1, allow_nan=False)


def _write_sweep_json(found: SweepResult, path: Path, **files: str) -> None:
    content = {**found.to_dict(), **files, "dcreg_version": __version__}
    text = json.dumps(_plain(content), indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def _write_sweep_csv(found: SweepResult, path: Path, **files: str) -> None:
    """The table, and the final pose row by row (T00, T01, ...); no value is an empty field."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = [
            _plain(row) | {f"T{i}{j}": value for (i, j), value in np.ndenumerate(T)}
            for row, T in zip(found.rows(), (r.T_target_source for r in found.results), strict=True)
        ]
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)


# Suffix of --out: how it is written.
_SWEEP_WRITERS: dict[str, Callable[..., None]] = {
    ".json": _write_sweep_json,
    ".csv": _write_sweep_csv,
}


def _print_sweep(console: Console, found: SweepResult) -> None:
    first = found.results[0]
    flat = first.model == "similarity2d"
    headings = ["pairs", "status", "lower bound", "upper bound", "RMS", "next pair", "proven by"]
    headings += ["nodes", "time"] if flat else ["RMSE of pose", "nodes", "time"]
    table = Table(*headings, box=None, pad_edge=False)
    for column in table.columns:
        column.no_wrap = True
        column.justify = "left" if column.header == "status" else "right"
    suggested = found.suggested_n_inliers
    for row in found.rows():
        cells = [
            f"{'* ' if row['n_inliers'] == suggested else ''}{row['n_inliers']}",
            row["status"],
            *(f"{row[name]:.5g}" for name in ("lower_bound", "upper_bound")),
            f"{row['rms_low']:.4g} to {row['rms']:.4g}",
            "" if row["next_pair"] is None else f"{row['next_pair']:.4g}",
            "" if row["proven_by"] is None else f"k={row['proven_by']}",
            *([] if flat else [f"{row['rmse_matched']:.4g}"]),
            str(row["n_nodes"]),
            f"{row['time_s']:.2f} s",
        ]
        table.add_row(*cells)
    if not console.is_terminal:  # a file has no width that columns would have to fit
        console.width = max(console.width, 160)
    console.print(table, highlight=False)
    for line in _sweep_legend(found):
        console.print(line, highlight=False, soft_wrap=True)


def _sweep_legend(found: SweepResult) -> Iterator[str]:
    first = found.results[0]
    yield (
        f"bounds on: {first.certificate_scope}; RMS: sqrt(bound / pairs), units of the target; "
        "next pair: rise of the upper bound per additional pair"
    )
    suggested = found.suggested_n_inliers
    if suggested is None:
        yield "suggestion: none, the RMSE of the poses has no clear elbow over these cardinalities"
    else:
        yield f"suggestion (*), not proven: {suggested} pairs, the elbow of the RMSE of the poses"


def _plain(value: Any) -> Any:
    match value:
        case dict():
            return {str(key): _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case np.ndarray() | np.generic():
            return _plain(value.tolist())
        case float() if not math.isfinite(value):
            return None
        case _:
            return value


def _print_summary(console: Console, result: Result) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, text in _summary(result):
        table.add_row(name, text)
    console.print(table, highlight=False)


def _summary(result: Result) -> Iterator[tuple[str, str]]:
    yield "status", _verdict(result)
    yield "T_target_source", _matrix(result.T_target_source)
    yield "scale", f"{result.scale:.6g}"
    yield "rotation", f"{_rotation_deg(result.rotation):.4f} deg"
    yield "RMSE of pairs", f"{result.rmse_matched:.6g} over {result.n_inliers} pairs"
    yield "lower bound", f"{result.lower_bound:.6g}"
    yield "upper bound", f"{result.upper_bound:.6g}"
    yield "gap", f"{result.gap:.4g} (tolerance {result.gap_tol:.4g})"
    yield "scope of bounds", result.certificate_scope
    yield from _stages(result)
    yield (
        "objective",
        f"{result.objective:.6g} (before the polish {result.objective_certified:.6g})",
    )
    yield "work", f"{result.n_nodes} nodes, {result.n_assignments} assignments"
    yield "time", f"{result.time_solve_s:.2f} s solving, {result.time_setup_s:.2f} s before"
    yield "method", f"{result.model}, mode {result.mode}, bound {result.bound}"


def _verdict(result: Result) -> str:
    if result.status is Status.OPTIMAL:
        return f"optimal: certified within the tolerance, for the {result.certificate_scope}"
    if result.status is Status.CONVERGED:
        return "converged: came to its own end, not certified"
    if result.gap <= result.gap_tol:
        return (
            f"{result.status.value}: best pose so far; certified for the "
            f"{result.certificate_scope}, but a later stage did not end"
        )
    return f"{result.status.value}: best pose so far, not certified"


def _stages(result: Result) -> Iterator[tuple[str, str]]:
    """One line per stage that bounds something, where there are several."""
    bounding = [stage for stage in result.stages if stage.status is not None]
    for stage in bounding if len(bounding) > 1 else []:
        yield (
            f"{stage.name} stage",
            f"{stage.status}, bounds [{stage.lower_bound:.5g}, {stage.upper_bound:.5g}], "
            f"{stage.n_nodes} nodes, {stage.time_s:.2f} s",
        )


def _matrix(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:>14.8g}" for value in row) for row in matrix)


def _rotation_deg(rotation: np.ndarray) -> float:
    """Signed angle in 2D, angle about the axis in 3D."""
    if len(rotation) == 2:
        return math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))
    # atan2 of sine and cosine keeps digits where the arc cosine has none, near 0 and 180 degrees
    skew = rotation - rotation.T
    sine = math.sqrt(skew[0, 1] ** 2 + skew[0, 2] ** 2 + skew[1, 2] ** 2) / 2
    return math.degrees(math.atan2(sine, (np.trace(rotation) - 1) / 2))


def _exit_code(status: Status) -> int:
    return EXIT_OK if status in (Status.OPTIMAL, Status.CONVERGED) else EXIT_LIMIT


def _print_error(log: Console, message: str) -> None:
    log.print(f"error: {message}", style="red", markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    app()
