"""Record the boxes that searches bound, to draw a search."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

import numpy as np

from dcreg.search.boxes import Boxes, Confined

MOST_BOXES = 500_000  # of all stages; the rest of a longer search is not recorded


@dataclass
class Recording:
    """The boxes of a stage in the order in which they were bounded.

    Attributes
    ----------
    rounds : list of (Boxes, array of bool)
        The boxes of each round, with their bounds, and which of them remain open.
    ends : list of (lower_bound, upper_bound, theta)
        Bounds and incumbent after each round.
    cuts : list of (int, Confined)
        The boxes to which a cover confined the search, and how many boxes were bounded before.
    """

    rounds: list[tuple[Boxes, np.ndarray]] = field(default_factory=list)
    ends: list[tuple[float, float, np.ndarray]] = field(default_factory=list)
    cuts: list[tuple[int, Confined]] = field(default_factory=list)


class Recorder:
    """The recordings of all stages of the searches in a `recording` context, by stage."""

    def __init__(self) -> None:
        self.stages: dict[str, Recording] = {}
        self.n_boxes, self.is_complete = 0, True

    def add(
        self, stage: str, boxes: Boxes, is_open: np.ndarray, end: tuple[float, float, np.ndarray]
    ) -> None:
        """Record a round of a search."""
        self.is_complete &= self.n_boxes + len(boxes) <= MOST_BOXES
        if not self.is_complete:  # smaller rounds that follow are left out, too: no gaps
            return
        self.n_boxes += len(boxes)
        recording = self.stages.setdefault(stage, Recording())
        recording.rounds.append((boxes, is_open))
        recording.ends.append(end)

    def confine(self, stage: str, confined: Confined) -> None:
        """Record that a search continues only in some boxes."""
        if not self.is_complete:
            return
        recording = self.stages.setdefault(stage, Recording())
        recording.cuts.append((sum(len(boxes) for boxes, _ in recording.rounds), confined))


_active: ContextVar[Recorder | None] = ContextVar("active", default=None)


def active() -> Recorder | None:
    """Return the recorder of the context, if there is one."""
    return _active.get()


@contextmanager
def recording() -> Iterator[Recorder]:
    """Record the boxes of the searches that this thread begins in the context."""
    recorder = Recorder()
    token = _active.set(recorder)
    try:
        yield recorder
    finally:
        _active.reset(token)
