"""Runs during which their whole job was killed: from outside, for lack of memory, or with its machine.

A job that ends by itself removes its file of progress (`workflows.stages.progress`). The next job of the
same chunk finds one only if the last job was killed; it names the instance that was being solved.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from dcreg.files import whole_file
from workflows.stages.progress import SUFFIX

MOST_KILLS = 2  # a run is tried again once
REASON = (
    "its job was killed {} times during this run (from outside, out of memory, or with its machine)"
)


class Kills:
    """How often the jobs of a chunk were killed, per instance; `path` is removed when all runs ended."""

    def __init__(self, runs_path: Path) -> None:
        self.path = runs_path.with_suffix(".kills.json")
        self._counts: dict[str, int] = _read(self.path)
        left = runs_path.with_suffix(SUFFIX)
        if instance_id := _read(left).get("instance_id"):
            self._add(instance_id)
        left.unlink(missing_ok=True)

    def _add(self, instance_id: str) -> None:
        self._counts[instance_id] = self._counts.get(instance_id, 0) + 1
        with whole_file(self.path) as part:
            part.write_text(json.dumps(self._counts), encoding="utf-8")

    def reason_against(self, instance_id: str) -> str:
        """Return why a run is not tried again; empty if it is."""
        count = self._counts.get(instance_id, 0)
        return REASON.format(count) if count >= MOST_KILLS else ""

    def clear(self) -> None:
        """Forget everything: all runs of the chunk have a result."""
        self.path.unlink(missing_ok=True)


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a small file; nothing if it is missing or damaged."""
    with suppress(OSError, ValueError):
        found = json.loads(path.read_text(encoding="utf-8"))
        return found if isinstance(found, dict) else {}
    return {}
