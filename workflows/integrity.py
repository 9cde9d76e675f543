"""Checksums of results: a damaged file or line is found before it is read, and computed again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dcreg.files import whole_file
from workflows import UserError

DAMAGED = ".damaged"  # suffix of a file that was set aside
SUMS = ".checksums"  # file of a folder; for each name, its last line counts
SUFFIXES = (".npz", ".parquet")  # `set_aside_damaged` renames these also without a checksum
REMEDY = (
    "copy the file again, or compute it again with `python -m workflows run EXPERIMENT` (evidence: "
    "`make evidence`)"
)
_LENGTH = 16  # hexadecimal digits of the checksum of a line


class DamagedError(UserError):
    """A file of results is damaged; the message names the file and the remedy."""


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

    A file of `SUFFIXES` without a checksum counts as damaged.
    """
    places = [folder, *(path for path in sorted(folder.rglob("*")) if path.is_dir())]
    damaged = [path for place in places for path in _damaged_in(place, SUFFIXES)]
    for path in damaged:
        path.rename(path.with_name(path.name + DAMAGED))
    return damaged


def refuse_damaged(folder: Path) -> None:
    """Refuse a folder with a file that differs from its checksum; files without one are accepted.

    Raises
    ------
    DamagedError
    """
    for path in _damaged_in(folder):
        raise DamagedError(f"{path}: damaged, its SHA-256 differs from that in {SUMS}; {REMEDY}")


def is_damaged(path: Path) -> bool:
    """Tell whether a file has a checksum and differs from it."""
    checksum = _checksums(path.parent).get(path.name)
    return checksum is not None and digest(path) != checksum


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Convert what other libraries raise for a damaged file without a checksum into `DamagedError`."""
    try:
        yield
    except (UserError, MemoryError):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise DamagedError(f"{path}: cannot be read ({reason}); {REMEDY}") from error


def _damaged_in(folder: Path, suffixes: Sequence[str] = ()) -> list[Path]:
    """Return the files of a folder that differ from their checksum.

    Also those with one of the suffixes that have no checksum.
    """
    stored = _checksums(folder)
    return [
        path
        for path in sorted(folder.glob("*"))
        if (path.name in stored or path.suffix in suffixes) and not path.name.startswith(".")
        and path.is_file() and digest(path) != stored.get(path.name)
    ]  # fmt: skip


def _checksums(folder: Path) -> dict[str, str]:
    """Return the last checksum of each file of a folder."""
    sums = folder / SUMS
    if not sums.is_file():
        return {}
    lines = sums.read_text(encoding="utf-8", errors="replace").splitlines()
    return {name: checksum for checksum, _, name in (line.partition("  ") for line in lines)}


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:_LENGTH]
