"""Checksums of results: a damaged file or line is found before it is read, and computed again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dcreg.files import whole_file

DAMAGED = ".damaged"  # suffix of a file that was set aside
SUMS = ".checksums"  # file of a folder; for each name, its last line counts
SUFFIXES = (".npz", ".parquet")  # of the files that have checksums
_LENGTH = 16  # hexadecimal digits of the checksum of a line


def sealed(row: dict[str, Any]) -> str:
    """Return a row as one line of JSON with a checksum."""
    text = json.dumps(row)
    return f"{text} {_checksum(text)}"


def opened(line: str) -> dict[str, Any] | None:
    """Return the row of a line; None if the line was cut off or changed."""
    text, _, checksum = line.rpartition(" ")
    return json.loads(text) if text and _checksum(text) == checksum else None


@contextmanager
def sealed_file(path: Path) -> Iterator[Path]:
    """Like `whole_file`, and store the checksum of the file in its folder."""
    with whole_file(path) as part:
        yield part
        # before the file is replaced: if the process ends in between, the old file counts as damaged
        with (path.parent / SUMS).open("a", encoding="utf-8") as sums:
            sums.write(f"{digest(part)}  {path.name}\n")


def set_aside_damaged(folder: Path) -> list[Path]:
    """Rename the damaged files of an experiment; return their old names.

    A file without a checksum counts as damaged.
    """
    places = [folder, *(path for path in sorted(folder.rglob("*")) if path.is_dir())]
    damaged = [path for place in places for path in _damaged_in(place)]
    for path in damaged:
        path.rename(path.with_name(path.name + DAMAGED))
    return damaged


def _damaged_in(folder: Path) -> list[Path]:
    """Return the files of a folder that differ from their last checksum."""
    sums, stored = folder / SUMS, {}
    if sums.is_file():
        for line in sums.read_text(encoding="utf-8", errors="replace").splitlines():
            checksum, _, name = line.partition("  ")
            stored[name] = checksum
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix in SUFFIXES and not path.name.startswith(".") and path.is_file()
        and digest(path) != stored.get(path.name)
    ]  # fmt: skip


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:_LENGTH]
