"""Clocks for tests of limits that a busy machine does not disturb."""

import time

import dcreg.search.budget

PATIENCE_S = 60.0  # in which the watching thread has looked at the clock, on any machine


class SetClock:
    """The clock of all budgets; it stands still until a test moves it.

    Attributes
    ----------
    now : float
        Seconds.
    """

    def __init__(self):
        self.now, self._looks = 1000.0, 0

    def __call__(self):
        self._looks += 1
        return self.now

    def is_seen(self, *flags):
        """Whether all flags are set after the watching thread has looked at the clock."""
        looks, end = self._looks, time.monotonic() + PATIENCE_S
        while self._looks < looks + 20 and time.monotonic() < end:
            time.sleep(0.001)
        return all(flag[0] for flag in flags)


class Stopwatch:
    """A listener that notes the processor time of every event.

    Parameters
    ----------
    stops : callable, optional
        Whether an event ends the solve; never by default.
    """

    def __init__(self, stops=lambda event: False):
        self.stops, self.stopped_at = stops, None
        self.heard = [time.process_time()]

    def __call__(self, event):
        self.heard.append(time.process_time())
        if self.stopped_at is None and self.stops(event):
            self.stopped_at = self.heard[-1]
        return self.stopped_at is not None

    def since_first(self):
        """Processor time since the first event."""
        return time.process_time() - self.heard[1]

    def since_stop(self):
        """Processor time since the event that ended the solve."""
        return time.process_time() - self.stopped_at


def use(monkeypatch, clock):
    """Let every budget read `clock`, and its watching thread look often."""

    class Time:
        perf_counter = staticmethod(clock)

    monkeypatch.setattr(dcreg.search.budget, "time", Time)
    monkeypatch.setattr(dcreg.search.budget, "_GLANCE_S", 0.005)
