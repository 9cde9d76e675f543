"""Count how often solve jobs were killed during a run.

A job deletes its file of progress (`workflows.stages.progress`) when it ends by itself. A file left
behind shows that the job was killed, and names the instance that it solved, up to a second earlier.
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
    "the job was killed {} times during this run, by a signal, for lack of memory or by a stop of the "
    "machine"
)


class Kills:
    """How often the jobs of a chunk were killed, per instance."""

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
        """Return why a run is not tried again, or an empty string if it is."""
        count = self._counts.get(instance_id, 0)
        return REASON.format(count) if count >= MOST_KILLS else ""

    def clear(self) -> None:
        """Delete the counts, because all runs of the chunk have a result."""
        self.path.unlink(missing_ok=True)


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a small file; an empty dictionary if it is missing or damaged."""
    with suppress(OSError, ValueError):
        found = json.loads(path.read_text(encoding="utf-8"))
        return found if isinstance(found, dict) else {}
    return {}
