"""The program with all of its commands."""

from dcreg.cli import commands, questions  # noqa: F401 (each adds its commands)
from dcreg.cli.app import app

__all__ = ["app"]
