"""The command line. What it does is done by the public names of `dcreg`; nothing here computes."""

from __future__ import annotations

import sys

from dcreg.cli import interrupts


def main() -> None:
    """Run the command ``dcreg``; where its packages are missing, say what to install."""
    interrupts.end_at_once()
    try:
        from dcreg.cli.commands import app

        app(prog_name="dcreg")
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in ("typer", "rich"):
            raise
        sys.exit(
            f"error: the command dcreg needs the package {missing}, which is missing here; install "
            "what it needs with: pip install typer rich plotly\n"
            "In Python the library works without: import dcreg"
        )
