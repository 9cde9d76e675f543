"""The output of the commands: messages, files and exit codes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import dcreg
from dcreg.cli.interrupts import raise_again
from dcreg.names import FIGURE_PACKAGES

if TYPE_CHECKING:
    import numpy as np

# 1 is left to Python: an unexpected error, or a missing package.
EXIT_OK, EXIT_INPUT, EXIT_LIMIT, EXIT_OUTPUT, EXIT_REFUSED, EXIT_REFUTED = 0, 2, 3, 4, 5, 6
STDOUT = Path("-")
MAX_NAME = 200  # bytes of the name of an output; the temporary file next to it has a longer name

# Writes one file, completely or not at all.
Writer = Callable[[Path], object]


def print_error(message: str) -> None:
    """Print one red line on standard error."""
    typer.secho(f"error: {message}", err=True, fg="red")


def print_warning(message: str) -> None:
    """Print one yellow line on standard error."""
    typer.secho(f"warning: {message}", err=True, fg="yellow")


def check_outputs(outputs: dict[str, Path | None], *inputs: str | None) -> None:
    """Fail before the search if a result could not be written after it.

    Parameters
    ----------
    outputs : dict
        The file of each option; ``-`` is standard output for ``--json``.
    *inputs : str, optional
        Files that are read and must not be overwritten.
    """
    # FILE:KEY is both a name and a file with a key
    files = {part for name in inputs if name for part in (name, name.rpartition(":")[0]) if part}
    taken: dict[Path, str] = {Path(name).resolve(): "an input" for name in files}
    for option, path in outputs.items():
        if path is None or (path == STDOUT and option == "--json"):
            continue
        if len(path.name.encode()) > MAX_NAME:
            raise dcreg.InputError(
                f"{option} {path.name[:40]}…: the name is too long; give a shorter one (at most "
                f"{MAX_NAME} bytes)"
            )
        if path.exists() and not path.is_file():
            raise dcreg.InputError(
                f"{option} {path}: exists and is not a regular file; name another file"
            )
        if (use := taken.get(path.resolve())) is not None:
            raise dcreg.InputError(f"{option} {path}: is also {use}; name another file")
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


def check_suffix(option: str, path: Path | None, known: Sequence[str]) -> None:
    """Refuse a file whose suffix is not one of `known`."""
    if path is not None and path.suffix.lower() not in known:
        raise dcreg.InputError(f"{option} {path}: the name must end in {' or '.join(known)}")


def check_figure(path: Path | None, known: list[str]) -> None:
    """Refuse a figure that could not be written: another suffix, or missing packages."""
    check_suffix("--plot", path, known)
    if path is None:
        return
    kind = path.suffix.lower()
    if missing := [name for name in FIGURE_PACKAGES[kind] if find_spec(name) is None]:
        raise dcreg.InputError(
            f"--plot {path}: {kind} files need {' and '.join(missing)}; install with: "
            f"pip install {' '.join(missing)}"
        )


def write_outputs(status: dcreg.Status, *writers: tuple[Path | None, Writer]) -> int:
    """Write each requested file; return the exit code of a search with this `status`."""
    raise_again()
    solved = status in (dcreg.Status.OPTIMAL, dcreg.Status.CONVERGED)
    code = EXIT_OK if solved else EXIT_LIMIT
    if status is dcreg.Status.REFUTED:
        code = EXIT_REFUTED
    for path, write in writers:
        if path is None:
            continue
        try:
            write(path)
        except OSError as error:
            code = EXIT_OUTPUT
            print_error(
                f"cannot write {path}: {error.strerror or error}; the result is printed above. "
                "Free some space or name a file elsewhere"
            )
    return code


def write_answer(
    found: Any,
    points: tuple[np.ndarray, np.ndarray],
    json_path: Path | None,
    plot_path: Path | None,
    names: dict[str, Any],
    *more_files: tuple[Path | None, Writer],
    in_files: Any = None,
) -> int:
    """Print an answer and write its files; return 0, or the exit code of a failure.

    Parameters
    ----------
    found : dcreg.answer.Answer
    points : (source, target)
    json_path, plot_path : Path, optional
    names : dict
        The clouds, as given, and further keys of the JSON.
    *more_files
        As in `write_outputs`.
    in_files : dcreg.answer.Answer, optional
        The answer with pairs that are rows of the files; default: `found`.
    """
    in_files = in_files or found
    to_stdout = json_path == STDOUT
    typer.echo(found, err=to_stdout)
    if to_stdout:
        typer.echo(in_files.to_json(**names))
        json_path = None
    shown = names["source"], names["target"]
    return write_outputs(
        dcreg.Status.OPTIMAL,
        (json_path, partial(in_files.write_json, **names)),
        (plot_path, lambda path: dcreg.plot_answer(*points, found, path, names=shown)),
        *more_files,
    )
