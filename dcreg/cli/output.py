"""What goes out: messages, files and exit codes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import typer

import dcreg
from dcreg.cli.interrupts import raise_again
from dcreg.names import FIGURE_PACKAGES

if TYPE_CHECKING:
    import numpy as np

EXIT_OK, EXIT_OUTPUT, EXIT_INPUT, EXIT_LIMIT = 0, 1, 2, 3
STDOUT = Path("-")
MAX_NAME = 200  # bytes of the name of an output; its neighbour while writing has a longer one
# The library's messages begin with the name of the argument; these are options here.
_OPTIONS = {"model", "n_inliers", "scale_range", "mode", "bound", "gap_tol", "tol", "threads"}
_OPTIONS |= {
    "time_limit",
    "node_limit",
    "candidates",
    "certificate",
    "downsample",
    "inlier_distance",
    "judge",
    "certify",
}

# Writes one file, whole or not at all.
Writer = Callable[[Path], object]


@contextmanager
def exit_on_bad_input() -> Iterator[None]:
    """Print an `InputError` and exit with the code for bad input."""
    try:
        yield
    except dcreg.InputError as error:
        print_error(_with_option_names(str(error)))
        raise typer.Exit(EXIT_INPUT) from None


def _with_option_names(message: str) -> str:
    name, colon, rest = message.partition(":")
    return f"--{name.replace('_', '-')}{colon}{rest}" if name in _OPTIONS else message


def print_error(message: str) -> None:
    """One red line on standard error."""
    typer.secho(f"error: {message}", err=True, fg="red")


def print_tolerance_advice(gap_tol: float | None, tol: float | None) -> None:
    """That a gap hardly ever closes to nothing, on standard error."""
    for option, value in (("--gap-tol", gap_tol), ("--tol", tol)):
        if value == 0:
            typer.secho(
                f"warning: {option} 0: a gap hardly ever closes completely, so the search ends at a "
                "limit or by Ctrl-C only; give a length such as --tol 0.01, or --time-limit 60",
                err=True,
                fg="yellow",
            )


def check_outputs(
    outputs: dict[str, Path | None], *inputs: str | None, stdout: str | None = None
) -> None:
    """Fail before the search if a result could not be written after it.

    Parameters
    ----------
    outputs : dict
        Option and file.
    *inputs : str, optional
        Files that are read, and must not be overwritten.
    stdout : str, optional
        The option for which ``-`` is standard output.
    """
    taken: dict[Path, str] = {Path(name).resolve(): "an input" for name in inputs if name}
    for option, path in outputs.items():
        if path is None or (path == STDOUT and option == stdout):
            continue
        if len(path.name.encode()) > MAX_NAME:
            raise dcreg.InputError(
                f"{option} {path.name[:40]}…: the name is too long; give a shorter one (up to "
                f"{MAX_NAME} bytes)"
            )
        if path.exists() and not path.is_file():
            raise dcreg.InputError(
                f"{option} {path}: exists and is not a plain file; name another file"
            )
        if (use := taken.get(path.resolve())) is not None:
            raise dcreg.InputError(f"{option} {path}: is {use} as well; name another file")
        taken[path.resolve()] = f"the file of {option}"
        if not path.parent.is_dir():
            raise dcreg.InputError(f"{option} {path}: no folder '{path.parent}'; create it first")
        try:
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        except OSError as error:
            raise dcreg.InputError(
                f"{option} {path}: cannot write in '{path.parent}' ({error.strerror}); "
                "name a file elsewhere"
            ) from None


def check_suffix(option: str, path: Path | None, known: list[str]) -> None:
    """Refuse a file whose name does not say how it is to be written."""
    if path is not None and path.suffix.lower() not in known:
        raise dcreg.InputError(f"{option} {path}: the name must end in one of {', '.join(known)}")


def check_packages(path: Path | None, kind: str) -> None:
    """Refuse a figure whose packages are missing."""
    missing = [name for name in FIGURE_PACKAGES[kind] if find_spec(name) is None]
    if path is not None and missing:
        raise dcreg.InputError(
            f"--plot {path}: {kind} files need {' and '.join(missing)}; install with: "
            f"pip install {' '.join(missing)}"
        )


def check_page(path: Path | None) -> None:
    """Refuse a page that could not be written: another suffix, or packages missing."""
    check_suffix("--plot", path, [".html"])
    check_packages(path, ".html")


def finish(
    result: dcreg.Result,
    clouds: tuple[np.ndarray, np.ndarray],
    inputs: dict[str, str],
    json_path: Path | None,
    others: list[tuple[Path | None, Writer]],
    plot_path: Path | None,
) -> NoReturn:
    """Print a registration, write its files and exit.

    Parameters
    ----------
    result : Result
    clouds : (source, target)
    inputs : dict
        Names of the files by what they are; the JSON and the page state them.
    json_path, plot_path : Path, optional
    others : list of (path, writer)
    """
    # standard output belongs to the JSON when it goes there
    to_stdout = json_path == STDOUT
    typer.echo(result, err=to_stdout)
    if to_stdout:
        typer.echo(result.to_json(**inputs))
        json_path = None
    names = inputs["source"], inputs["target"]
    complete = write_outputs(
        [
            (json_path, lambda path: result.write_json(path, **inputs)),
            *others,
            (plot_path, lambda path: dcreg.plot_registration(*clouds, result, path, names=names)),
        ]
    )
    raise typer.Exit(exit_code(result.status, complete))


def write_outputs(writers: list[tuple[Path | None, Writer]]) -> bool:
    """Write each file that was asked for; False if one could not be written."""
    raise_again()
    complete = True
    for path, write in writers:
        if path is None:
            continue
        try:
            write(path)
        except OSError as error:
            complete = False
            print_error(
                f"cannot write {path}: {error.strerror or error}; the result is printed above, "
                "free some space or name a file elsewhere"
            )
    return complete


def exit_code(status: dcreg.Status, complete: bool) -> int:
    """By what was written and how the run ended."""
    if not complete:
        return EXIT_OUTPUT
    solved = status in (dcreg.Status.OPTIMAL, dcreg.Status.CONVERGED)
    return EXIT_OK if solved else EXIT_LIMIT
