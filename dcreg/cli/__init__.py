"""The command line, which uses only public names of `dcreg` and computes nothing itself."""

from __future__ import annotations

import sys

from dcreg.cli import interrupts


def main() -> None:
    """Run the command ``dcreg``; if a package is missing, say what to install."""
    interrupts.end_at_once()
    try:
        from dcreg.cli.commands import app

        app(prog_name="dcreg")
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in ("typer", "rich"):
            raise
        sys.exit(
            f"error: the command dcreg needs the package {missing}, which is not installed; install "
            "its packages with: pip install typer rich plotly\n"
            "The Python library (import dcreg) works without them"
        )
