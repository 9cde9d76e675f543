"""Bound history of a search: one event per change of a bound, and always a closing event."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Event:
    """State of a search at one moment.

    ``kind`` is ``start``, ``bound`` (a bound moved), ``tick`` (regular report) or ``end``.
    ``stage`` names the search that speaks (``search``, ``rotation``).
    """

    kind: str
    stage: str
    time_s: float
    n_nodes: int
    n_assignments: int
    n_open: int
    lower_bound: float
    upper_bound: float
    status: str = ""

    @property
    def gap(self) -> float:
        return max(0.0, self.upper_bound - self.lower_bound)


# Called with every event; returning True asks the search to stop (status "stopped").
Listener = Callable[[Event], bool | None]


@dataclass
class Trace:
    """Ordered events of one run."""

    events: list[Event] = field(default_factory=list)

    def __iter__(self) -> Iterator[Event]:
        return iter(self.events)

    def __len__(self) -> int:
        return len(self.events)

    def rows(self) -> list[dict[str, object]]:
        return [asdict(event) for event in self.events]

    def write_jsonl(self, path: str | Path) -> None:
        """One JSON object per line; the last one has kind ``end`` and the status."""
        with open(path, "w", encoding="utf-8") as stream:
            for row in self.rows():
                stream.write(json.dumps(row) + "\n")
