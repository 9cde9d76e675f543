"""The program ``dcreg``: how its commands are made, and what they share.

A command loads what it needs when it runs: `--help` and `--version` load neither NumPy nor the solver.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial
from typing import Annotated, Any, NoReturn, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

import dcreg
from dcreg.cli import output
from dcreg.cli.interrupts import Interrupt, leave
from dcreg.cli.numbers import parse_count
from dcreg.cli.options import ARGUMENTS, flag, parameters_of, with_options

# In the order of the help.
ORDER = (
    "register", "sweep", "register-matches", "certify", "alternatives", "max-inliers", "batch",
    "verify", "version",
)  # fmt: skip


class Commands(TyperGroup):
    """The commands; a signal that interrupts one of them gives one line and an exit code."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names in the order of `ORDER`."""
        return sorted(super().list_commands(ctx), key=ORDER.index)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except Interrupt as interrupt:
            leave(interrupt)


class OneCommand(TyperCommand):
    """A command that names the commands with an option that it lacks."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Reject an option of other commands, before Typer proposes a similar one."""
        own = _options_of(self)
        for name in (arg.partition("=")[0] for arg in args):
            owners = [] if name in own else _owners(ctx.parent.command, name)
            if owners:
                *most, last = owners
                listed = f"{', '.join(most)} or {last}" if most else last
                output.print_error(
                    f"{name}: not an option of `dcreg {self.name}`; omit {name}, or use {listed}"
                )
                raise typer.Exit(output.EXIT_INPUT)
        return super().parse_args(ctx, args)


def _owners(group: Any, option: str) -> list[str]:
    """Return the commands that have an option, as they are typed."""
    commands = {name: group.commands[name] for name in ORDER}
    has_option = (name for name, each in commands.items() if option in _options_of(each))
    return [f"`dcreg {name}`" for name in has_option]


def _options_of(command: Any) -> set[str]:
    """Return the names of the options of a command."""
    options = (each for each in command.params if each.param_type_name == "option")
    return {name for each in options for name in (*each.opts, *each.secondary_opts)}


app = typer.Typer(
    name="dcreg",
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def command(function: Callable[..., int]) -> Callable[..., int]:
    """Add a command that returns its exit code; bad input gives one line and `EXIT_INPUT`.

    Each field of a parameter that is a dataclass becomes a parameter of the command.
    """
    hints = get_type_hints(function)
    groups: dict[str, Any] = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    parameters = list(parameters_of(function))
    parameters.sort(key=lambda each: each.default is not inspect.Parameter.empty)
    names = {each.name for each in parameters}.difference(ARGUMENTS)
    options = {name.removesuffix("_path"): flag(name) for name in names}

    @functools.wraps(function)
    def run(**given: Any) -> NoReturn:
        for name, kind in groups.items():
            given[name] = kind(
                **{each: given.pop(each) for each in inspect.signature(kind).parameters}
            )
        try:
            code = function(**given)
        except dcreg.InputError as error:
            ranges = given["poses"].names if "poses" in given else {}
            output.print_error(with_options(str(error), options | ranges))
            code = output.EXIT_INPUT
        raise typer.Exit(code)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    about, *_ = (inspect.getdoc(function) or "").split("\n\nParameters\n")
    app.command(help=about, cls=OneCommand)(run)
    return function


def run_search(
    solve: Callable[..., Any], *given: Any, quiet: bool, options: dict[str, Any], **keywords: Any
) -> Any:
    """Call `solve` while its progress is shown and Ctrl-C stops it."""
    from dcreg.cli.progress import Progress

    absolute = any(keywords.get(name) for name in ("abs_gap", "tol"))
    if keywords.get("rel_gap") == 0 and not (absolute or quiet):
        output.print_warning(
            "--rel-gap 0: unless the fit is exact, the gap hardly ever closes completely, so the search "
            "ends without a proof; give a share such as --rel-gap 0.001"
        )
    with Progress(quiet=quiet) as progress:
        chosen = dcreg.SolveOptions(**options, listener=progress)
        return progress.run(partial(solve, *given, **keywords, options=chosen))


def required_count(n_inliers: str | None) -> int | float:
    """Return `--n-inliers`, which must be given."""
    if n_inliers is None:
        raise dcreg.InputError(
            "--n-inliers: missing; give the number of pairs to match, such as 40 or 0.8, or let "
            "`dcreg sweep` suggest one"
        )
    return parse_count(n_inliers)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dcreg {dcreg.__version__}")
        raise typer.Exit


@app.callback()
def dcreg_command(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Globally optimal point cloud registration by branch and bound."""
