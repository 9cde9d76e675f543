"""Reuse runs that are stored in archives.

Archives lie in ``reports/archive/VERSION`` (`reports.archive` describes the files). The environment
variable ``DCREG_ARCHIVES`` names the folders to search instead, separated as in ``PATH``; if it is empty,
no archive is used.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from workflows import CHECKOUT, UserError, records
from workflows.integrity import digest
from workflows.journal import Key, as_lines, key_of
from workflows.outcomes import STARTED

if TYPE_CHECKING:
    import pandas as pd

ARCHIVES = CHECKOUT / "reports" / "archive"
CHECKSUMS, RUNS, TRACES = "checksums.sha256", "runs.parquet", "traces.parquet"
PROVENANCE = "provenance.json"  # of an experiment or a study
FACTS = "archive.json"


class ArchiveError(UserError):
    """An archive is missing, damaged or unsafe; the message names the file and the remedy."""


def folders() -> list[Path]:
    """Return the folders of archives, the latest last."""
    chosen = os.environ.get("DCREG_ARCHIVES")
    places = [ARCHIVES] if chosen is None else [Path(p) for p in chosen.split(os.pathsep) if p]
    found = [path.parent for place in places for path in place.glob("*/archive.json")]
    return sorted(found, key=lambda folder: facts(folder)["created"])


def facts(folder: Path) -> dict[str, Any]:
    """Return the content of ``archive.json``.

    Raises
    ------
    ArchiveError
    """
    with readable(folder):
        content = json.loads((folder / FACTS).read_text(encoding="utf-8"))
        if not isinstance(content, dict) or not isinstance(content.get("created"), str):
            raise ArchiveError(f"{folder / FACTS}: states no date; get the archive again")
        return content


@contextmanager
def readable(folder: Path) -> Iterator[None]:
    """Turn what other libraries raise for damaged files of an archive into an error of the archive.

    A right checksum shows only that a file is the one that was sent.

    Raises
    ------
    ArchiveError
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise ArchiveError(f"{folder}: cannot be read ({reason}); get the archive again") from error


def check(folder: Path) -> None:
    """Refuse an archive with a missing or damaged file, or of another version of the schema.

    Raises
    ------
    ArchiveError, SchemaError
    """
    path = folder / CHECKSUMS
    if not path.is_file():
        raise ArchiveError(f"{path}: missing; {folder} is not an archive")
    with readable(folder):
        lines = [line.partition("  ") for line in path.read_text(encoding="utf-8").splitlines()]
    if absent := {FACTS, RUNS, TRACES} - {name for _, _, name in lines}:
        raise ArchiveError(f"{path}: does not list {min(absent)}; get the archive again")
    for stated, _, name in lines:
        if not is_inside(name) or not (folder / name).is_file():
            raise ArchiveError(f"{folder / name}: listed in {CHECKSUMS} and missing; get it again")
        if digest(folder / name) != stated:
            raise ArchiveError(
                f"{folder / name}: damaged, its SHA-256 is not {stated}; get it again"
            )
    if unlisted := files_in(folder) - {CHECKSUMS} - {name for _, _, name in lines}:
        raise ArchiveError(
            f"{folder / min(unlisted)}: not listed in {CHECKSUMS}; remove it or get the archive again"
        )
    version = facts(folder).get("schema_version")
    records.check_version(version, str(folder), "read it with the checkout that wrote it")


def files_in(folder: Path) -> set[str]:
    """Return the relative paths of all files of an archive, without those that file managers add."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {path.as_posix() for path in files if not path.name.startswith(".")}


def is_inside(name: str) -> bool:
    """Tell whether a relative path of an archive stays inside its folder."""
    path = PurePosixPath(name.replace("\\", "/"))
    return bool(name) and not path.is_absolute() and ".." not in path.parts


def archived(method: str) -> dict[Key, dict[str, Any]]:
    """Return the archived runs of a method by run_id, input and fingerprint, in the form of a journal.

    Failed ones as well: otherwise only failures would get a second chance. Bound histories are thinned.
    If several archives have the same run, the latest one counts.

    Raises
    ------
    ArchiveError, SchemaError
    """
    found: dict[Key, dict[str, Any]] = {}
    for folder in folders():
        for row in _rows(folder, method):
            found[key_of(row)] = row
    return found


def runs_of(experiment: str) -> pd.DataFrame | None:
    """Return the runs of an experiment in the latest archive that has some; None if none has.

    Raises
    ------
    ArchiveError, SchemaError
    """
    import pandas as pd

    for folder in reversed(folders()):
        _checked(folder)
        with readable(folder):
            runs = pd.read_parquet(folder / RUNS, filters=[("experiment", "==", experiment)])
        if len(runs):
            return runs
    return None


def runs_of_others(experiment: str) -> pd.DataFrame | None:
    """Return the runs of all other experiments in the latest archive; None without an archive.

    Raises
    ------
    ArchiveError, SchemaError
    """
    import pandas as pd

    if not (known := folders()):
        return None
    _checked(known[-1])
    with readable(folder := known[-1]):
        return pd.read_parquet(folder / RUNS, filters=[("experiment", "!=", experiment)])


def _rows(folder: Path, method: str) -> Iterator[dict[str, Any]]:
    import pandas as pd

    _checked(folder)
    wanted = [("method", "==", method), ("outcome", "in", STARTED)]
    columns = ["experiment", *records.RAW]
    runs = pd.read_parquet(folder / RUNS, columns=columns, filters=wanted)
    if runs.empty:
        return
    ids = set(runs["run_id"])
    events = pd.read_parquet(folder / TRACES, filters=[("run_id", "in", ids)])
    # several experiments may have the same run
    for experiment, part in runs.groupby("experiment", sort=False):
        own = events[events["experiment"] == experiment]
        yield from as_lines(part.drop(columns="experiment"), own)


@functools.cache
def _checked(folder: Path) -> None:
    check(folder)
