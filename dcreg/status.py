"""How a run ended: one vocabulary for the library, every baseline and every report."""

from __future__ import annotations

import enum


class Status(enum.StrEnum):
    """How a run ended; a string, so that it compares with and prints as its value."""

    #: The bounds closed to `gap_tol`: certified within the stated scope.
    OPTIMAL = "optimal"
    #: A local or heuristic method came to its own end; nothing is proven.
    CONVERGED = "converged"
    #: The caller asked to stop.
    STOPPED = "stopped"
    #: The time was up; the best pose is kept.
    TIME_LIMIT = "time_limit"
    #: So many boxes were bounded; the best pose is kept.
    NODE_LIMIT = "node_limit"
    #: The open boxes filled the memory they may use; the best pose is kept.
    MEMORY_LIMIT = "memory_limit"
    #: Raised, crashed, was killed from outside, or gave no pose.
    FAILED = "failed"
    #: The method cannot treat this kind of problem.
    UNSUPPORTED = "unsupported"
    #: The method is not installed here.
    UNAVAILABLE = "unavailable"
    #: Planned, but not run.
    NOT_RUN = "not_run"

    @property
    def is_limit(self) -> bool:
        """Whether a limit of time, boxes or memory ended the run."""
        return self in (Status.TIME_LIMIT, Status.NODE_LIMIT, Status.MEMORY_LIMIT)
