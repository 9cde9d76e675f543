"""Runs of archives, which are used instead of repeating them.

Archives lie in ``reports/archive/VERSION`` (`reports.archive` describes the files). The environment
variable ``DCREG_ARCHIVES`` names other folders of archives, or none if it is empty.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from workflows import CHECKOUT, UserError, records

HERE = CHECKOUT / "reports" / "archive"
CHECKSUMS, RUNS, TRACES = "checksums.sha256", "runs.parquet", "traces.parquet"
REUSED = ("finished", "limited")  # outcomes; a failed run is tried again
Key = tuple[str, str, str]


class ArchiveError(UserError):
    """An archive is missing, damaged or unsafe; the message names the file and the remedy."""


def folders() -> list[Path]:
    """Return the folders of archives, the latest last."""
    chosen = os.environ.get("DCREG_ARCHIVES")
    places = [HERE] if chosen is None else [Path(p) for p in chosen.split(os.pathsep) if p]
    found = [path.parent for place in places for path in place.glob("*/archive.json")]
    return sorted(found, key=lambda folder: facts(folder)["created"])


def facts(folder: Path) -> dict[str, Any]:
    """Return the content of ``archive.json``."""
    return json.loads((folder / "archive.json").read_text(encoding="utf-8"))


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check(folder: Path) -> None:
    """Refuse an archive with a missing or damaged file, or of another version of the schema.

    Raises
    ------
    ArchiveError, SchemaError
    """
    path = folder / CHECKSUMS
    if not path.is_file():
        raise ArchiveError(f"{path}: missing; {folder} is not an archive")
    for line in path.read_text(encoding="utf-8").splitlines():
        stated, _, name = line.partition("  ")
        if not is_inside(name) or not (folder / name).is_file():
            raise ArchiveError(f"{folder / name}: listed in {CHECKSUMS} and missing; get it again")
        if digest(folder / name) != stated:
            raise ArchiveError(
                f"{folder / name}: damaged, its SHA-256 is not {stated}; get it again"
            )
    records.check_version(
        facts(folder)["schema_version"], str(folder), "use the checkout of its version"
    )


def is_inside(name: str) -> bool:
    """Tell whether a relative path of an archive stays inside its folder."""
    path = PurePosixPath(name.replace("\\", "/"))
    return bool(name) and not path.is_absolute() and ".." not in path.parts


def archived(method: str) -> dict[Key, dict[str, Any]]:
    """Return the archived runs of a method by run_id, input and fingerprint, in the form of a journal.

    Only finished and limited ones. Their bound histories are thinned. Of equal runs, that of the latest
    archive counts.

    Raises
    ------
    ArchiveError, SchemaError
    """
    found: dict[Key, dict[str, Any]] = {}
    for folder in folders():
        for row in _rows(folder, method):
            found[row["run_id"], row["instance_digest"], row["fingerprint"]] = row
    return found


def _rows(folder: Path, method: str) -> Iterator[dict[str, Any]]:
    import pandas as pd

    _checked(folder)
    wanted = [("method", "==", method), ("outcome", "in", REUSED)]
    runs = pd.read_parquet(folder / RUNS, columns=list(records.RAW), filters=wanted)
    if runs.empty:
        return
    ids = set(runs["run_id"])
    events = pd.read_parquet(folder / TRACES, filters=[("run_id", "in", ids)])
    shown = [name for name in records.RAW_TRACES if name not in ("run_id", "instance_id")]
    histories = {
        run_id: _plain(part[shown]) for run_id, part in events.groupby("run_id", sort=False)
    }
    for row in _plain(runs):
        yield {**row, "trace": histories.get(row["run_id"], [])}


@functools.cache
def _checked(folder: Path) -> None:
    check(folder)


def _plain(table: Any) -> list[dict[str, Any]]:
    """Return the rows without their missing values."""
    return [
        {name: value for name, value in row.items() if value == value and value is not None}
        for row in table.to_dict("records")
    ]
