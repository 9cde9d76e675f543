"""What every reader says the same way: the one error, and its recurring words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from dcreg.problem import InputError

DIMENSIONS = (2, 3)
EXPORT = "export the file again"  # the remedy for damage that no text editor mends


def fail(path: Path, problem: str, remedy: str) -> NoReturn:
    """Refuse a file, with the remedy."""
    raise InputError(f"{path}: {problem}; {remedy}")


def listing(names: Sequence[str], most: int = 12) -> str:
    """Names for a message, not too many of them."""
    rest = f", ... ({len(names)} in all)" if len(names) > most else ""
    return ", ".join(names[:most]) + rest if names else "none"
