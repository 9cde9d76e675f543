"""Checksums of results: a damaged file or line is found before it is read, and computed again."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dcreg.files import whole_file

DAMAGED = ".damaged"  # suffix of a file that was set aside
SUMS = ".checksums"  # file of a folder; for each name, its last line counts
SUFFIXES = (".npz", ".parquet")  # of the files that have checksums
MADE_FROM_RUNS = ("metrics", "tables", "report")  # folders of a view of an experiment
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
    """Rename the damaged files of an experiment, so that Snakemake makes them again; return them.

    A file without a checksum counts as damaged.
    """
    damaged = [path for path in sorted(folder.rglob("*")) if _has_sum(path) and not is_sound(path)]
    for path in damaged:
        path.rename(path.with_name(path.name + DAMAGED))
    return damaged


def remove_made_from_runs(folder: Path) -> None:
    """Remove what is made from the runs of an experiment.

    Snakemake makes no missing file again while everything made from it exists.
    """
    for name in MADE_FROM_RUNS:
        for place in (folder, folder / "evidence"):
            shutil.rmtree(place / name, ignore_errors=True)
    shutil.rmtree(folder / "parts", ignore_errors=True)


def is_sound(path: Path) -> bool:
    """Tell whether a file has the checksum that was stored when it was written."""
    sums = path.parent / SUMS
    if not sums.is_file():
        return False
    lines = sums.read_text(encoding="utf-8", errors="replace").splitlines()
    stored = [line.partition("  ")[0] for line in lines if line.partition("  ")[2] == path.name]
    return bool(stored) and digest(path) == stored[-1]


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _has_sum(path: Path) -> bool:
    return path.suffix in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:_LENGTH]
