"""``dcreg verify``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import dcreg
from dcreg.cli.output import EXIT_OK, exit_on_bad_input

EXIT_REFUSED = 1


def verify(
    certificate: Annotated[Path, typer.Argument(metavar="CERT", help="File of --certificate.")],
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="The cloud that was moved.")],
    target: Annotated[str, typer.Argument(metavar="TARGET", help="The cloud that stayed.")],
) -> None:
    """Check a certificate against its clouds, in plain NumPy, without the search.

    Exit code: 0 the claim is proven; 1 refused, with the reason; 2 bad input.
    """
    with exit_on_bad_input():
        if not certificate.is_file():
            raise dcreg.InputError(
                f"{certificate}: no such file; `dcreg register --certificate` writes one"
            )
        report = dcreg.verify(certificate, dcreg.read_points(source), dcreg.read_points(target))
    for check in report.checks:
        typer.echo(f"ok: {check}")
    if not report.accepted:
        typer.echo(f"refused: {report.reason}")
    elif report.is_trivial:
        typer.echo(
            f"holds, but says nothing: {report.statement}; 0 bounds every sum of squares. Register "
            "with a smaller --gap-tol or more time for a bound above it"
        )
    else:
        typer.echo(f"proven: {report.statement}")
    raise typer.Exit(EXIT_OK if report.accepted else EXIT_REFUSED)
