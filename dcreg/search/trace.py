"""Bound history of a search: one event per change of a bound, and always a closing event."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from dcreg.files import as_json, write_text


@dataclass(frozen=True)
class Event:
    """State of a search at one moment.

    Attributes
    ----------
    kind : {"bound", "tick", "end"}
        A bound moved; a regular report; the search is over.
    stage : str
        The search that speaks (``search``, ``rotation``, ``k=40`` …).
    time_s : float
        Seconds since the solve began; one clock for all stages.
    n_nodes, n_assignments, n_open : int
        Of this stage: boxes bounded, exact assignments, boxes still to be divided.
    lower_bound, upper_bound : float
    status : str
        How the search ended; empty before.
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
        """Absolute gap ``upper_bound - lower_bound``, never negative."""
        return max(0.0, self.upper_bound - self.lower_bound)

    def scaled(self, factor: float) -> Event:
        """The same moment with its bounds in other units."""
        return replace(
            self, lower_bound=factor * self.lower_bound, upper_bound=factor * self.upper_bound
        )


@dataclass
class Trace:
    """Bound history of one run; iterating gives its events in order.

    Attributes
    ----------
    events : list of Event
    """

    events: list[Event] = field(default_factory=list)

    def __iter__(self) -> Iterator[Event]:
        return iter(self.events)

    def __len__(self) -> int:
        return len(self.events)

    def rows(self) -> list[dict[str, object]]:
        """One dictionary of plain values per event, for tables and figures."""
        return [asdict(event) for event in self.events]

    def write_jsonl(self, path: str | Path) -> None:
        """One JSON object per line; the last one has kind ``end`` and the status.

        An infinite bound becomes null.
        """
        write_text(path, "".join(as_json(row, indented=False) + "\n" for row in self.rows()))
