"""What the command lines of `workflows` and `reports` share."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, NoReturn

import psutil
import typer

from data.contract import DataError
from workflows import UserError

Experiment = Annotated[
    str, typer.Argument(help="Name of a config in workflows/configs, or a path.")
]
Folder = Annotated[Path, typer.Argument(help="Results of an experiment: results/<name>.")]
Out = Annotated[Path, typer.Option()]
# Of the commands that repeat a run.
RunId = Annotated[str, typer.Argument(help="From column run_id of tables/runs.csv.")]
ConfigOfRun = Annotated[
    str, typer.Option(help="Config of the run; default: the one recorded with the run.")
]
Stored = Annotated[Path, typer.Option(help="Folder of results to search before the archives.")]


def user_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """Report an error that the user can fix as one line, with exit code 2 and no traceback."""

    @wraps(command)
    def checked(*arguments: Any, **options: Any) -> Any:
        try:
            return command(*arguments, **options)
        except (ValueError, DataError) as error:
            from baselines.registry import BaselineError

            if isinstance(error, UserError | BaselineError | DataError):
                stop(str(error))
            raise

    return checked


def say(text: str) -> None:
    """Print a line of progress with the seconds that this process has taken."""
    print(f"{text}; {time.time() - psutil.Process().create_time():.1f} s", flush=True)


def stop(message: str) -> NoReturn:
    """Print an error message and end with exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    raise typer.Exit(2)
