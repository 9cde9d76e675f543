"""Progress of a search: one live line on a terminal, plain lines elsewhere, and a clean Ctrl-C."""

from __future__ import annotations

import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from types import FrameType
from typing import Self, TypeVar

from rich.console import Console
from rich.live import Live
from rich.text import Text

import dcreg
from dcreg.cli.interrupts import SIGNALS, Interrupt

# Its INFO records report the work outside of searches, such as compilation.
_LIBRARY = logging.getLogger("dcreg")
T = TypeVar("T")
_GLANCE_S = 0.1  # between two checks for a signal
_WAITING_S = 5.0  # between two plain lines without a search
_SILENT_S = 1.0  # without an event, of which a search sends several a second unless it compiles
_WITHOUT_NEWS = "compiling or finishing"  # after a time limit there are no events either
_SAME = 1e-3  # relative change of the upper bound up to which the pose counts as found before
_HEADER = (
    f"  {'stage':<11}{'nodes':>9}{'open':>7}{'pose at':>9}"
    f"{'lower bound':>12}{'upper bound':>12}{'proven':>10}{'time':>8}"
)


@dataclass(eq=False)
class Progress:
    """A `dcreg.Listener` that shows the state of a search and stops it on Ctrl-C.

    It is a context manager around the search. The first signal (SIGINT or SIGTERM) stops the search and
    keeps the best pose. A second one, or one before the search has begun, raises `Interrupt`.

    Parameters
    ----------
    console : rich.console.Console
        Where to write; default: standard error.
    interval_s : float
        Minimum time between two plain lines.
    quiet : bool
        Show nothing, but still stop on a signal.
    step : str
        The work until the first event.
    """

    console: Console = field(default_factory=partial(Console, stderr=True))
    _: KW_ONLY
    interval_s: float = 1.0
    quiet: bool = False
    step: str = "preparing the search"

    def __post_init__(self) -> None:
        self.stop_requested = False
        self._live: Live | None = None
        self._began = time.monotonic()
        self._heard, self._heard_at = False, 0.0
        self._header_shown = False
        self._last_print = -math.inf
        self._stage = ""
        self._last_upper = math.inf
        self._improved = False
        self._found_s, self._found_upper = math.inf, math.inf
        self._pending: dcreg.Event | None = None
        self._undo = ExitStack()

    def __enter__(self) -> Self:
        with suppress(ValueError):  # handlers can be set in the main thread only
            for number in SIGNALS:
                self._undo.callback(signal.signal, number, signal.signal(number, self._on_signal))
        if self.quiet:
            return self
        self._undo.callback(_LIBRARY.setLevel, _LIBRARY.level)
        _LIBRARY.setLevel(logging.INFO)
        messages = _Messages(self.console)
        self._undo.callback(_LIBRARY.removeHandler, messages)
        _LIBRARY.addHandler(messages)
        if self.console.is_terminal:
            live = Live(Text(self.step), console=self.console, refresh_per_second=8)
            self._live = self._undo.enter_context(live)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is None and self._pending is not None:
            self._print(self._pending)
        self._undo.close()

    def __call__(self, event: dcreg.Event) -> bool:
        self._heard, self._heard_at = True, time.monotonic()
        if not self.quiet:
            self._show(event)
        return self.stop_requested

    def run(self, solve: Callable[[], T]) -> T:
        """Call `solve` in a separate thread, so that signals are handled while kernels run."""
        outcome: list[T] = []
        errors: list[BaseException] = []

        def work() -> None:
            try:
                outcome.append(solve())
            except BaseException as error:
                errors.append(error)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        while thread.is_alive():
            thread.join(_GLANCE_S)
            if not self.quiet:
                self._show_waiting()
        if errors:
            raise errors[0]
        return outcome[0]

    def prove(self, done: int, needed: int) -> None:
        """Show how far the check of a certificate is: boxes bounded, and boxes known to be needed."""
        needed = max(done, needed)
        self.step = f"proving the bounds: {done} of {needed} {'box' if needed == 1 else 'boxes'}"

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if self.stop_requested or not self._heard:
            raise Interrupt(number)
        self.stop_requested = True
        # print() is not safe in a signal handler; os.write is
        os.write(2, b"\nstopping; the best pose is kept (interrupt again to quit at once)\n")

    def _show_waiting(self) -> None:
        """Show the work outside of a search: checks, sampling, proof, and compilation also within one."""
        now = time.monotonic()
        if self._heard and now - self._heard_at < _SILENT_S:
            return
        step, since = (_WITHOUT_NEWS, self._heard_at) if self._heard else (self.step, self._began)
        line = f"{step}, {now - since:.0f} s"
        if self._live is not None:
            self._live.update(Text(line))
        elif now - max(since, self._last_print) >= _WAITING_S:
            self.console.print(line, highlight=False, soft_wrap=True)
            self._last_print = now

    def _show(self, event: dcreg.Event) -> None:
        if not self._header_shown:
            self._show_header()
        self._note_improvement(event)
        if self._live is not None:
            shown = f"{self._line(event)}\n  {_note(event)}"
            self._live.update(Text(shown, no_wrap=True, overflow="crop"))
            self._improved = False
        elif event.kind == "end" or time.monotonic() - self._last_print >= self.interval_s:
            self._print(event)
        else:
            self._pending = event

    def _note_improvement(self, event: dcreg.Event) -> None:
        is_same = math.isclose(event.upper_bound, self._found_upper, rel_tol=_SAME)
        if event.stage != self._stage:
            self._stage = event.stage
            # with the same value it continues with the same pose; otherwise its objective may be another
            if not is_same:
                self._last_upper = math.inf
        self._improved |= event.upper_bound < self._last_upper
        self._last_upper = min(self._last_upper, event.upper_bound)
        if not is_same:
            is_known = math.isfinite(event.upper_bound)
            self._found_s = event.time_s if is_known else math.inf
            self._found_upper = event.upper_bound

    def _show_header(self) -> None:
        self.console.print(
            "pose at: time of the best pose (objective within 0.1 %); bounds in squared units of the "
            "target\n"
            "proven: lower bound in % of the upper bound\n"
            "*: better pose since the last line; Ctrl-C stops the search and keeps the best pose",
            highlight=False,
            soft_wrap=True,
        )
        self.console.print(Text(_HEADER, style="bold"), soft_wrap=True)
        self._header_shown = True

    def _print(self, event: dcreg.Event) -> None:
        self.console.print(Text(f"{self._line(event)}  {_note(event)}".rstrip()), soft_wrap=True)
        self._last_print = time.monotonic()
        self._pending = None
        self._improved = False

    def _line(self, event: dcreg.Event) -> str:
        mark = "*" if self._improved else " "
        return (
            f"{mark} {event.stage:<11}{event.n_nodes:>9}{event.n_open:>7}{_seconds(self._found_s):>9}"
            f"{_number(event.lower_bound, 5):>12}{_number(event.upper_bound, 5):>12}"
            f"{_proven(event):>10}{_seconds(event.time_s):>8}"
        )


class _Messages(logging.Handler):
    """Messages of the library, shown above the live line on a terminal."""

    def __init__(self, console: Console) -> None:
        super().__init__(logging.INFO)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        self._console.print(record.getMessage(), highlight=False, markup=False, soft_wrap=True)


def _proven(event: dcreg.Event) -> str:
    if event.status == "optimal" and event.lower_bound <= 0.0:
        return "exact fit"
    # rounded down: only a closed gap is 100 %, but a computed 99 % is not 98.9 %
    return f"{math.floor(1000.0 * event.bound_ratio + 1e-6) / 10.0:.1f} %"


def _note(event: dcreg.Event) -> str:
    """Return how the search ended or, before, when its proof is expected."""
    if event.status or event.expected_s is None:
        return event.status
    if math.isinf(event.expected_s):
        return "proof not expected in time"
    return f"proof expected in about {math.ceil(event.expected_s)} s"


def _seconds(value: float) -> str:
    return f"{value:.1f}s" if math.isfinite(value) else "-"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}g}" if math.isfinite(value) else "-"
