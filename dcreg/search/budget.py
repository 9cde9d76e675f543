"""When a search stops (limits, clock), and the events that report its progress."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np

from dcreg.search.tolerance import proven_share
from dcreg.status import Status


@dataclass(frozen=True)
class Event:
    """State of a search at one moment.

    Attributes
    ----------
    kind : {"bound", "heartbeat", "end"}
        A bound changed; no bound changed for a quarter of a second, or a cover starts; the search ends.
    stage : str
        The current stage (``search``, ``rotation``, ``k=40`` …).
    time_s : float
        Seconds since the solve began, the same clock for all stages.
    n_nodes, n_assignments, n_open : int
        Boxes bounded, exact assignments solved, and open boxes of this stage.
    lower_bound, upper_bound : float
    status : str
        How the search ended; empty until then.
    expected_s : float, optional
        Estimated seconds from now until the proof; inf if this exceeds the time for a proof; None if
        unknown.
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
    expected_s: float | None = None

    @property
    def gap(self) -> float:
        """Absolute gap ``upper_bound - lower_bound``, at least 0."""
        return max(0.0, self.upper_bound - self.lower_bound)

    @property
    def bound_ratio(self) -> float:
        """Lower bound divided by upper bound."""
        return proven_share(self.lower_bound, self.upper_bound)

    def scaled(self, factor: float) -> Event:
        """Return the same event with its bounds in other units."""
        return replace(
            self, lower_bound=factor * self.lower_bound, upper_bound=factor * self.upper_bound
        )


class Checkpoint(Protocol):
    """Saves the state of a search, a `dcreg.search.space_search.Course`, to continue it later."""

    @property
    def is_resumed(self) -> bool:
        """Whether it holds the state of an earlier search."""
        ...

    def restore(self, course: Any) -> None:
        """Continue `course` from the saved state."""
        ...

    def save(self, course: Any, at_once: bool) -> None:
        """Save the state after a round, if the last time is long ago or `at_once`."""
        ...


# Called with every event; returning True asks the solve to stop (status "stopped").
Listener = Callable[[Event], bool | None]

_GLANCE_S = 0.05  # interval between readings of the clock while a kernel runs
_SILENCE_S = 0.25  # time without an event after which the last one is repeated
# Seconds after a time limit for the objective of the final pose: a share of the limit plus a constant.
_CLOSING_SHARE, _CLOSING_S = 0.05, 0.2


class Interrupted(Exception):  # noqa: N818 (not an error: it never leaves the library)
    """A kernel was stopped before its end. Raised and caught within the library."""


class Clock:
    """The clock of a solve, which can be paused."""

    def __init__(self) -> None:
        # since when it is paused, if it is, and the seconds of earlier pauses
        self._state: tuple[float | None, float] = None, 0.0

    @property
    def prepared_s(self) -> float:
        """Seconds that do not count, of pauses that have ended."""
        return self._state[1]

    @property
    def is_paused(self) -> bool:
        return self._state[0] is not None

    def now(self) -> float:
        """Return the seconds of this clock; they do not increase while it is paused."""
        while True:
            state = paused_at, prepared_s = self._state
            moment = time.perf_counter() if paused_at is None else paused_at
            if state is self._state:  # otherwise a pause has begun or ended meanwhile
                return moment - prepared_s

    def exclude(self, seconds: float) -> None:
        """Do not count seconds that have passed, such as those of a preparation."""
        paused_at, prepared_s = self._state
        self._state = paused_at, prepared_s + seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Pause the clock, for instance while kernels are compiled."""
        paused_at, prepared_s = self._state
        if paused_at is not None:
            yield
            return
        began = time.perf_counter()
        self._state = began, prepared_s
        try:
            yield
        finally:
            self._state = None, prepared_s + time.perf_counter() - began


class Budget:
    """Limits on time, boxes, memory and assignments of a solve, handed down from stage to stage.

    As a context manager, it runs a thread that watches the clock, because kernels do not: at the limit
    the thread sets `stop`. The thread also repeats the last event after a quarter of a second without
    events, so that a caller can stop the search at any time. The listener is then called from this
    thread as well, but never concurrently.

    Parameters
    ----------
    time_s : float, optional
        Time limit in seconds from now on; None or inf: no limit.
    nodes : int, optional
        Maximum number of boxes bounded by each search.
    memory_mb : float, optional
        Maximum memory of the open boxes of a search, in MiB.
    listener : callable, optional
        Receives every event; returning True sets `stopped`.
    assignments : int, optional
        Maximum number of exact assignments of each search, checked between its rounds.

    Attributes
    ----------
    stop : (1,) uint8 array
        Set when the solve is over; kernels then return at once. It is set only within the context.
    hard_stop : (1,) uint8 array
        The same for the steps that complete the result; it is set slightly later.
    is_watched : bool
        Whether a listener receives the events.
    history : list of Event
        Events of all stages except heartbeats.
    clock : Clock
        Of this budget and all its parts.
    checkpoint : Checkpoint, optional
        Set before the search; all parts share it.
    earlier_s : float
        Seconds of earlier parts of the solve, which `elapsed` includes.
    patience_s : float or None
        Seconds that a search may take for a proof; inf: only the time of the budget limits it; None: the
        search continues even if no proof is expected.
    observer : callable or None
        Of all budgets of the process; receives every event, in normalised units, and changes no search.
    """

    observer: ClassVar[Callable[[Event], None] | None] = None

    def __init__(
        self,
        time_s: float | None = None,
        nodes: int | None = None,
        memory_mb: float | None = None,
        listener: Listener | None = None,
        assignments: int | None = None,
    ) -> None:
        self.nodes, self.memory_mb, self.assignments = nodes, memory_mb, assignments
        self.history: list[Event] = []
        self.stop, self.hard_stop = np.zeros(1, np.uint8), np.zeros(1, np.uint8)
        self._listener, self.is_watched = listener, listener is not None
        self.clock = Clock()
        self._began, self._reported_at = self.clock.now(), time.perf_counter()
        time_s = None if time_s == np.inf else time_s
        self._deadline = None if time_s is None else self._began + time_s
        closing_s = _CLOSING_S + _CLOSING_SHARE * (time_s or 0.0)
        self._closing = None if self._deadline is None else self._deadline + closing_s
        # the budget from which all parts derive; it knows whether the caller asked to stop
        self._root = self
        self.patience_s: float | None = None
        self.checkpoint: Checkpoint | None = None
        self.earlier_s = 0.0
        self._stopped = False
        self._reports = True
        self._incumbent = -np.inf
        self._stage = "start"
        self._event = Event("heartbeat", "start", 0.0, 0, 0, 0, 0.0, np.inf)
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._watch: threading.Thread | None = None
        self._stages: list[Budget] = []  # isolated parts, each with its own stop flags
        self._error: BaseException | None = None

    def __enter__(self) -> Self:
        if self._deadline is not None or self._listener is not None:
            self._watch = threading.Thread(target=self._keep_watch, daemon=True)
            self._watch.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        if self._watch is not None:
            self._watch.join()
        if self._error is not None and error[0] is None:
            raise self._error

    def _keep_watch(self) -> None:
        over_at: float | None = None
        while not self._ended.wait(_GLANCE_S):
            now = self.clock.now()
            try:
                is_silent = time.perf_counter() - self._reported_at >= _SILENCE_S
                if is_silent and over_at is None and not self.clock.is_paused:
                    self.report(
                        replace(self._event, kind="heartbeat", time_s=self.elapsed(), status="")
                    )
            except BaseException as error:  # from the listener: raised again in the calling thread
                self._error, self._stopped = error, True
            for stage in self._stages:
                stage.stop[0] |= stage.is_over
            if over_at is None and self.is_over:
                over_at, self.stop[0] = now, 1
            is_late = self.stopped and over_at is not None and now - over_at >= _CLOSING_S
            for part in (self, *self._stages):
                part.hard_stop[0] |= is_late or part._is_closing(now)

    def _is_closing(self, now: float) -> bool:
        return self._closing is not None and now >= self._closing

    def elapsed(self) -> float:
        """Return the seconds since the solve began. All parts share this clock."""
        return self.clock.now() - self._began

    @property
    def resumed(self) -> Checkpoint | None:
        """The checkpoint, if it holds the state of an earlier search."""
        return (
            self.checkpoint if self.checkpoint is not None and self.checkpoint.is_resumed else None
        )

    def add_earlier(self, elapsed_s: float, history: list[Event]) -> None:
        """Count the time and the events of an earlier part of the solve; the time left stays."""
        self._began -= elapsed_s
        self.earlier_s += elapsed_s
        self.history[:0] = history

    def left(self) -> float | None:
        """Return the seconds left, never negative; None without a limit."""
        if self._deadline is None:
            return None
        return max(0.0, self._deadline - self.clock.now())

    @property
    def stopped(self) -> bool:
        """Whether the listener asked to stop, in any part."""
        return self._root._stopped

    @property
    def is_over(self) -> bool:
        """Whether the time is up or the caller asked to stop. Nothing new should then begin."""
        late = self._deadline is not None and self.clock.now() > self._deadline
        return late or self.stopped

    def spent(self, nodes: int, assignments: int, nbytes: float) -> Status | None:
        """Return the status of a search that has reached a limit of work or memory, or None."""
        if self.nodes is not None and nodes >= self.nodes:
            return Status.NODE_LIMIT
        if self.assignments is not None and assignments >= self.assignments:
            return Status.ASSIGNMENT_LIMIT
        if self.memory_mb is not None and nbytes > self.memory_mb * 2**20:
            return Status.MEMORY_LIMIT
        return None

    @property
    def ended_by(self) -> Status:
        """Status of a search that the clock or the caller ended."""
        return Status.STOPPED if self.stopped else Status.TIME_LIMIT

    def sub_budget(self, share: float) -> Budget:
        """Return a budget with the same limits but only this share of the remaining time."""
        part = object.__new__(Budget)
        part.__dict__.update(self.__dict__)
        left = self.left()
        part._deadline = None if left is None else self.clock.now() + share * left
        return part

    def isolated_sub_budget(self, share: float) -> Budget:
        """Return a sub-budget with its own stop flags, which end its stage in time for the next one."""
        part, now = self.sub_budget(share), self.clock.now()
        if self._closing is not None:
            part._closing = now + share * max(0.0, self._closing - now)
        part.stop, part.hard_stop = self.stop.copy(), self.hard_stop | part._is_closing(now)
        self._root._stages.append(part)
        return part

    def named(self, stage: str) -> Budget:
        """Return the same budget with another stage name for reported incumbents."""
        part = self.sub_budget(1.0)
        part._stage = stage
        return part

    def with_patience(self, patience_s: float | None) -> Budget:
        """Return the same budget with another patience.

        If boxes or assignments are limited, the patience is None, because the end of the search must then
        not depend on the clock.
        """
        part = self.sub_budget(1.0)
        part.patience_s = None if self.is_counted else patience_s
        return part

    @property
    def is_counted(self) -> bool:
        """Whether boxes or assignments are limited."""
        return self.nodes is not None or self.assignments is not None

    def silent(self) -> Budget:
        """Return the same budget without reports of incumbents, for a search over other points."""
        part = self.sub_budget(1.0)
        part._reports = False
        return part

    def with_incumbent(self, value: float) -> Budget:
        """Return the same budget for a search over more poses than are admissible.

        Events have an upper bound of at least `value`, the objective of an admissible pose.
        """
        part = self.sub_budget(1.0)
        part._incumbent = value
        return part

    def report_incumbent(self, value: float) -> None:
        """Report the objective of a better pose found outside a search."""
        if not self._reports:
            return
        self.report(Event("bound", self._stage, self.elapsed(), 0, 0, 0, 0.0, value))

    def report(self, event: Event) -> None:
        """Pass an event to the listener."""
        root = self._root
        if event.upper_bound < self._incumbent:
            event = replace(event, upper_bound=self._incumbent)
        with root._lock:
            root._reported_at, root._event = time.perf_counter(), event
            if event.kind != "heartbeat":
                root.history.append(event)
            if Budget.observer is not None:
                Budget.observer(event)
            if self._listener is not None and self._listener(event):
                root._stopped = True
                for part in (root, *root._stages) if root._watch is not None else ():
                    part.stop[0] = 1  # at once, without waiting for the next reading of the clock
