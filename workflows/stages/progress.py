"""The state of a solve job while it runs: a small file next to its results, for `workflows.live`.

The file is written at most once a second and removed at the end of the job. A file that is older than
`STALE_S` was left behind by a job that was killed.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from dcreg.files import whole_file

SUFFIX = ".progress.json"
WRITE_S = 1.0
STALE_S = 10.0


@dataclass
class Running:
    """A solve that runs now.

    Attributes
    ----------
    method, chunk, instance_id : str
    since : float
        When it began, in seconds since 1970.
    proven : float or None
        Lower bound divided by upper bound; None for methods that report none.
    """

    method: str
    chunk: str
    instance_id: str
    since: float
    proven: float | None = None


class Reporter:
    """Writes the file of a solve job, ``<chunk>.progress.json``; a context manager that removes it."""

    def __init__(self, method: str, runs_path: Path) -> None:
        self.path = runs_path.with_suffix(SUFFIX)
        self._running = Running(method, runs_path.stem, "", 0.0)
        self._written = -float("inf")

    def __enter__(self) -> Reporter:
        return self

    def __exit__(self, *error: object) -> None:
        self.path.unlink(missing_ok=True)

    def begin(self, instance_id: str) -> None:
        """Note that a solve begins."""
        self._running = Running(self._running.method, self._running.chunk, instance_id, time.time())
        self.alive()

    def alive(self, proven: float | None = None) -> None:
        """Note that the solve still runs and, if given, what it has proven."""
        if proven is not None:
            self._running.proven = proven
        if time.monotonic() - self._written < WRITE_S:
            return
        self._written = time.monotonic()
        with suppress(OSError), whole_file(self.path) as part:
            part.write_text(json.dumps(asdict(self._running)), encoding="utf-8")


def running(runs_folder: Path) -> Iterator[Running]:
    """Yield the solves that run now, of all methods of an experiment."""
    for path in sorted(runs_folder.glob(f"*/*{SUFFIX}")):
        with suppress(OSError, ValueError, TypeError):
            if time.time() - path.stat().st_mtime < STALE_S:
                yield Running(**json.loads(path.read_text(encoding="utf-8")))
