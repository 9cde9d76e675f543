"""How a run ended: one vocabulary for the library, every baseline and every report."""

from __future__ import annotations

import enum


class Status(enum.StrEnum):
    """How a run ended."""

    OPTIMAL = "optimal"  # bounds closed to gap_tol: certified within the stated scope
    CONVERGED = "converged"  # a local or heuristic method came to its own end
    STOPPED = "stopped"  # the caller asked to stop
    TIME_LIMIT = "time_limit"
    NODE_LIMIT = "node_limit"
    MEMORY_LIMIT = "memory_limit"
    FAILED = "failed"  # raised, crashed or was killed from outside
    UNSUPPORTED = "unsupported"  # the method cannot treat this kind of problem
    UNAVAILABLE = "unavailable"  # the method is not installed here
    NOT_RUN = "not_run"

    @property
    def is_limit(self) -> bool:
        return self in (Status.TIME_LIMIT, Status.NODE_LIMIT, Status.MEMORY_LIMIT)
