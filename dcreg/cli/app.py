"""The commands of ``dcreg`` and their versions.

What a command needs is loaded when it runs: `--help` and `--version` load neither NumPy nor the solver.
"""

from __future__ import annotations

import platform
from importlib.metadata import version as package_version
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import dcreg
from dcreg.cli.interrupts import Interrupt, leave
from dcreg.cli.matches import register_matches
from dcreg.cli.register import register
from dcreg.cli.sweep import sweep
from dcreg.cli.verify import verify


class Commands(TyperGroup):
    """The commands; a signal that none of them treats itself is one line and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except Interrupt as interrupt:
            leave(interrupt)


app = typer.Typer(
    name="dcreg",
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command()(register)
app.command()(register_matches)
app.command()(sweep)
app.command()(verify)


@app.command()
def version() -> None:
    """Print the versions that decide a result."""
    typer.echo(f"dcreg {dcreg.__version__}")
    packages = ("numpy", "scipy", "numba")
    listing = ", ".join(f"{name} {package_version(name)}" for name in packages)
    typer.echo(f"python {platform.python_version()}, {listing}")


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
