"""How a run ended, in the same terms for the library, every baseline and every report."""

from __future__ import annotations

import enum


class Status(enum.StrEnum):
    """How a run ended: a string, which compares and prints as its value."""

    #: The gap is closed by bounds that prove the optimum within the stated scope.
    OPTIMAL = "optimal"
    #: The method finished without a proof of the optimum; its bounds, if any, are valid.
    CONVERGED = "converged"
    #: It is proven that no pose is as good as requested (`max_rms`).
    REFUTED = "refuted"
    #: The caller stopped the run.
    STOPPED = "stopped"
    #: It hit the time limit; the best pose is kept.
    TIME_LIMIT = "time_limit"
    #: It hit the node limit; the best pose is kept.
    NODE_LIMIT = "node_limit"
    #: It hit the limit on assignments; the best pose is kept.
    ASSIGNMENT_LIMIT = "assignment_limit"
    #: Its open boxes hit the memory limit; the best pose is kept.
    MEMORY_LIMIT = "memory_limit"
    #: It raised an error, crashed, was killed, or returned no pose.
    FAILED = "failed"
    #: The method does not support this kind of problem.
    UNSUPPORTED = "unsupported"
    #: The method is not installed.
    UNAVAILABLE = "unavailable"
    #: The run is planned, but was not executed.
    NOT_RUN = "not_run"

    @property
    def is_limit(self) -> bool:
        """Whether a limit of time, work or memory ended the run."""
        return self.value.endswith("_limit")
