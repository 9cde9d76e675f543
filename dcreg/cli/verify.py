"""``dcreg verify``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import dcreg
from dcreg.cli import options
from dcreg.cli.output import EXIT_OK, exit_on_bad_input

EXIT_REFUSED = 1


def verify(
    certificate: Annotated[Path, typer.Argument(metavar="CERT", help="File of --certificate.")],
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="The cloud that was moved.")],
    target: Annotated[str, typer.Argument(metavar="TARGET", help="The cloud that stayed.")],
    quiet: options.QuietOption = False,
) -> None:
    """Check a certificate against its clouds, in plain NumPy, without the search.

    Exit code: 0 the claim is proven; 1 refused, with the reason; 2 bad input.
    """
    from dcreg.cli.progress import ProofProgress

    with exit_on_bad_input():
        clouds = dcreg.read_points(source), dcreg.read_points(target)
        with ProofProgress(quiet=quiet) as progress:
            report = dcreg.verify(certificate, *clouds, progress=progress)
        if not report.is_certificate:
            raise dcreg.InputError(report.reason)
    for check in report.checks:
        typer.echo(f"ok: {check}")
    if report.accepted:
        if report.is_trivial:
            typer.echo(
                f"holds, but says nothing: {report.statement}; 0 bounds every sum of squares. "
                "Register with a smaller --gap-tol or more time for a bound above it"
            )
        else:
            typer.echo(f"proven: {report.statement}")
        raise typer.Exit(EXIT_OK)
    typer.echo(
        f"refused: {report.reason}; check the clouds, or "
        "make a new one with `dcreg register --certificate`"
    )
    raise typer.Exit(EXIT_REFUSED)
