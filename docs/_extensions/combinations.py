"""Tables of the models, modes and options that each command accepts, generated from the command line.

Each combination is called on a small problem, up to the start of the search. The tables therefore show
what the checks of the program accept; there is no second list to maintain.
"""

from __future__ import annotations

import functools
import io
import os
import string
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from listings import table
from typer.main import get_command

from dcreg.cli.app import ORDER
from dcreg.cli.pair import solve
from dcreg.cli.program import app
from dcreg.names import MODEL_DIM, mode_files

N_POINTS = 6
NO_OPTION, NO_NUMBER = "no option", "no `--n-inliers`"
# Options with values that fit the files of `problem_files`.
OPTIONS = {
    NO_OPTION: "",
    NO_NUMBER: "",
    "--axis": "--axis 0,0,1",
    "--max-angle": "--max-angle 30",
    "--max-translation": "--max-translation 1",
    "--no-rotation": "--no-rotation",
    "--scale-range": "--scale-range 0.9 1.1",
    "--init": "--init pose{dim}.txt",
    "--candidates": "--candidates pairs.txt",
    "--source-weights": "--source-weights weights.txt --weight-distance 1",
    "--source-attributes": "--source-attributes weights.txt --target-attributes weights.txt "
    "--attribute-scale 1",
    "--certificate": "--certificate out.npz",
    "--checkpoint": "--checkpoint state.npz",
    "--downsample": "--downsample 5",
    "--max-rms": "--max-rms 1",
}
# Values of required arguments and options.
REQUIRED = {
    "pose": "pose{dim}.txt", "source": "cloud{dim}.txt", "target": "cloud{dim}.txt",
    "pairs": "pairs{dim}.csv", "out_path": "out.csv", "distance": "1", "n_inliers": "1.0",
}  # fmt: skip


@functools.cache
def program() -> Any:
    """Return the program with its commands."""
    return get_command(app)


class Combination(NamedTuple):
    """A command (question), a model with a mode, and an option."""

    question: str
    model: str
    mode: str
    option: str

    def arguments(self) -> list[str]:
        """Return the command line."""
        command = program().commands[self.question]
        found, has_mode = [self.question], False
        for each in command.params:
            has_mode |= each.name == "mode"
            is_number = each.name == "n_inliers"
            if each.name in REQUIRED and (each.required or is_number):
                is_left_out = is_number and self.option == NO_NUMBER
                name = [] if each.param_type_name == "argument" else [each.opts[0]]
                found += [] if is_left_out else [*name, REQUIRED[each.name]]
        found += ["--model", self.model]
        if has_mode or (self.model, self.mode) == ("rigid3d", "paper"):  # other modes are defaults
            found += ["--mode", self.mode]
        found += OPTIONS[self.option].split()
        return [part.format(dim=MODEL_DIM[self.model]) for part in found]

    def refusal(self) -> str:
        """Return why the command line is refused; empty if its search starts."""
        return refusal(self.arguments())


class _Started(BaseException):
    """Raised where a search would start: all checks have passed."""


def _start(*_: Any, **__: Any) -> None:
    raise _Started


def refusal(arguments: list[str]) -> str:
    """Return the error message of a command, or nothing if its search starts."""
    Path("out.csv").unlink(missing_ok=True)  # otherwise, a batch would continue it
    printed, code = io.StringIO(), 0
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            program()([*arguments, "--quiet"], prog_name="dcreg")
    except _Started:
        return ""
    except SystemExit as end:
        code = end.code
    if code != 2:
        raise RuntimeError(f"{arguments}: {printed.getvalue()}")
    return next(line for line in printed.getvalue().splitlines() if line.startswith("error: "))


@contextmanager
def problem_files() -> Iterator[None]:
    """Enter a folder with the files of a small problem; searches stop at their start."""
    before = Path.cwd()
    with ExitStack() as stack:
        os.chdir(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.callback(os.chdir, before)
        rows = np.arange(N_POINTS)
        np.savetxt("weights.txt", 1.0 + rows)
        np.savetxt(
            "pairs.txt", np.column_stack([np.repeat(rows, 2), [*rows, *np.roll(rows, 1)]]), "%d"
        )
        for dim in (2, 3):
            np.savetxt(f"cloud{dim}.txt", np.random.default_rng(0).random((N_POINTS, dim)))
            np.savetxt(f"pose{dim}.txt", np.eye(dim + 1))
            Path(f"pairs{dim}.csv").write_text(f"source,target\ncloud{dim}.txt,cloud{dim}.txt\n")
        for compiled in ("driver.solve.warm_up_mode", "driver.solve.warm_up_region"):
            stack.enter_context(mock.patch(f"dcreg.{compiled}"))
        stack.enter_context(mock.patch("dcreg.questions.alternatives.warm_up_region", create=True))
        stack.enter_context(mock.patch("dcreg.driver.solve.Setup.budget", _start))
        stack.enter_context(mock.patch("dcreg.cli.batch.solve_all", _solve_here))
        yield


def _solve_here(tasks: Any, *_: Any, quiet: bool) -> Iterator[tuple[Any, Any]]:
    for task in tasks:
        yield task, solve(task)


def questions() -> list[str]:
    """Return the commands that search poses of a model."""
    commands = program().commands
    return [name for name in ORDER if any(each.name == "model" for each in commands[name].params)]


def combinations() -> list[Combination]:
    """Return all combinations."""
    return [
        Combination(question, model, mode, option)
        for question in questions()
        for model, mode in mode_files()
        for option in OPTIONS
    ]


@functools.cache
def refusals() -> dict[Combination, str]:
    """Return the message that refuses each combination; it is empty if the search starts."""
    with problem_files():
        return {each: each.refusal() for each in combinations()}


def works(question: str, option: str, kind: tuple[str, str] | None = None) -> bool:
    """Tell whether a question works with an option, for one model and mode or for any."""
    kinds = list(mode_files()) if kind is None else [kind]
    return any(not refusals()[Combination(question, *each, option)] for each in kinds)


def cells() -> list[bool]:
    """Return for each cell of both tables whether it works: questions by modes, options by questions."""
    return [
        *(works(question, NO_OPTION, kind) for question in questions() for kind in mode_files()),
        *(works(q, option) for option in OPTIONS if option != NO_OPTION for q in questions()),
    ]


def tables() -> str:
    """Return both tables and the numbers of cells and combinations that work."""
    letters = dict(zip(mode_files(), string.ascii_uppercase, strict=False))

    def row(option: str) -> list[str]:
        return [
            "".join(letter for kind, letter in letters.items() if works(q, option, kind))
            for q in questions()
        ]

    kinds = [f"{letter}: `{m}`, mode `{name}`" for (m, name), letter in letters.items()]
    by_mode = [
        [f"`{q}`", *("yes" if works(q, NO_OPTION, kind) else "" for kind in letters)]
        for q in questions()
    ]
    by_option = [
        [option if option == NO_NUMBER else f"`{option}`", *row(option)]
        for option in OPTIONS
        if option != NO_OPTION
    ]
    every, found = refusals().values(), cells()
    share = (
        f"{sum(found)} of the {len(found)} cells of both tables have an entry. Of all {len(every)} "
        f"combinations of command, model, mode and at most one option, {sum(not each for each in every)} "
        "work."
    )
    options = table(["option", *(f"`{q}`" for q in questions())], by_option)
    return "\n\n".join([table(["command", *kinds], by_mode), options, share])
