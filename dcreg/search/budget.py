"""What a solve may spend, and who is told of its progress."""

from __future__ import annotations

import time
from collections.abc import Callable

from dcreg.search.trace import Event

# Called with every event; returning True asks the solve to stop (status "stopped").
Listener = Callable[[Event], bool | None]


class Budget:
    """Clock, boxes and memory of a solve, handed down from stage to stage.

    Parameters
    ----------
    time_s : float, optional
        Seconds from now on; None: no limit.
    nodes : int, optional
        Boxes bounded by every search.
    memory_mb : float, optional
        Memory of the open boxes of a search.
    listener : callable, optional
        Told of every event; what it returns decides about `stopped`.
    """

    def __init__(
        self,
        time_s: float | None = None,
        nodes: int | None = None,
        memory_mb: float | None = None,
        listener: Listener | None = None,
    ) -> None:
        self.nodes, self.memory_mb = nodes, memory_mb
        self._listener = listener
        self._began = time.perf_counter()
        self._deadline = None if time_s is None else self._began + time_s
        self._root = self  # of all parts: the one that knows whether the caller asked to stop
        self._stopped = False

    def elapsed(self) -> float:
        """Seconds since the solve began; the same clock in all parts."""
        return time.perf_counter() - self._began

    def left(self) -> float | None:
        """Seconds left, never negative; None without a limit."""
        if self._deadline is None:
            return None
        return max(0.0, self._deadline - time.perf_counter())

    @property
    def stopped(self) -> bool:
        """Whether the listener asked to stop, in whatever part."""
        return self._root._stopped

    @property
    def is_over(self) -> bool:
        """Whether nothing new should begin: the time is up, or the caller asked to stop."""
        late = self._deadline is not None and time.perf_counter() > self._deadline
        return late or self.stopped

    def part(self, share: float) -> Budget:
        """A budget for one stage: the same limits, but only this share of the time left."""
        part = object.__new__(Budget)
        part.__dict__.update(self.__dict__)
        left = self.left()
        part._deadline = None if left is None else time.perf_counter() + share * left
        return part

    def tell(self, event: Event) -> None:
        """Pass an event on to the listener."""
        if self._listener is not None and self._listener(event):
            self._root._stopped = True
