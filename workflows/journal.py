"""Journals: the finished runs of a job, a sealed line each, which a later job reads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from workflows import records
from workflows.integrity import opened

if TYPE_CHECKING:
    import pandas as pd

Key = tuple[str, str, str]


def key_of(row: dict[str, Any]) -> Key:
    """Return what must be equal for an old result to be used again."""
    return row["run_id"], row["instance_digest"], row["fingerprint"]


def journalled(folder: Path) -> dict[Key, dict[str, Any]]:
    """Return the finished runs of a method by run_id, input and fingerprint; the last one counts."""
    return {key_of(row): row for _, row in lines_of(folder)}


def lines_of(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the intact lines of the journals of a method, each with its file."""
    for path in sorted(folder.glob("*.journal.jsonl")):
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            if row := opened(line):
                yield path, row


def as_lines(runs: pd.DataFrame, events: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield the rows of tables in the form of a journal."""
    shown = [name for name in records.RAW_TRACES if name not in ("run_id", "instance_id")]
    histories = {run: _plain(part[shown]) for run, part in events.groupby("run_id", sort=False)}
    for row in _plain(runs):
        yield {**row, "trace": histories.get(row["run_id"], [])}


def _plain(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows without their missing values."""
    return [
        {str(name): value for name, value in row.items() if value == value and value is not None}
        for row in table.to_dict("records")
    ]


def appending(path: Path) -> IO[str]:
    """Open the journal for new lines, also after one that was cut off."""
    cut_off = path.is_file() and not path.read_bytes().endswith(b"\n") and path.stat().st_size > 0
    stream = path.open("a", encoding="utf-8")
    if cut_off:
        stream.write("\n")
    return stream
