"""Best-first branch and bound over cubes divided in eight, with a bound history and true limits."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from baselines.contract import Limits
from dcreg.status import Status

OCTANTS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
_NODE_BYTES = 400  # of a queue entry with its centre, without the payload


class OutOfTimeError(Exception):
    """Raised by a bound when the deadline passed before it knew its answer."""


@dataclass
class Incumbent:
    """The least value found of the objective, and where."""

    value: float = np.inf
    pose: Any = None

    def offer(self, value: float, pose: Any) -> bool:
        """Take the pose if it is better."""
        if value < self.value:
            self.value, self.pose = float(value), pose
            return True
        return False


# (centre, half-width, parent's lower bound, parent's payload) -> (lower bound, payload). Improves
# the incumbent on the way; +inf for a cube without admissible points; may raise OutOfTimeError.
CubeBound = Callable[[np.ndarray, float, float, Any], tuple[float, Any]]


@dataclass
class OctreeSearch:
    """Minimise over cubes to within `gap_tol` of the incumbent's value.

    Attributes
    ----------
    bound : CubeBound
    incumbent : Incumbent
    gap_tol : float
    limits : Limits
    began, deadline : float
        Moments of `time.perf_counter()`: the trace counts from the first, the search ends by the
        second.
    unit : float
        The trace's bounds are ``offset + unit * value``, in the caller's units.
    stage : str
    floor : float
        A value that the objective is never below.
    """

    bound: CubeBound
    incumbent: Incumbent
    gap_tol: float
    limits: Limits
    began: float
    deadline: float
    unit: float = 1.0
    offset: float = 0.0
    stage: str = "search"
    floor: float = 0.0
    n_nodes: int = 0
    trace: list[dict[str, Any]] = field(default_factory=list)
    payload_bytes: int = 0

    def run(self, roots: list[tuple[np.ndarray, float]], payload: Any = None) -> Status:
        """Search the cubes (centre, half-width); ``self.lower_bound`` is valid for any status."""
        self.lower_bound = self.floor
        self._serial = 0
        self._pruned = np.inf  # least bound among cubes given up: part of the certificate
        self._queue: list[tuple[float, float, int, np.ndarray, Any]] = []
        self._record("start")
        status = self._expand(roots, self.floor, payload)
        while status is None:
            self._settle()
            if self.incumbent.value - self.lower_bound <= self.gap_tol:
                status = Status.OPTIMAL
            else:
                status = self._limit() or self._divide()
        self._settle()
        self._record("end")
        return status

    def _divide(self) -> Status | None:
        bound, minus_half, _, centre, payload = heapq.heappop(self._queue)
        self.payload_bytes -= _size(payload)
        half = -minus_half / 2
        return self._expand([(centre + half * step, half) for step in OCTANTS], bound, payload)

    def _expand(
        self, cubes: list[tuple[np.ndarray, float]], inherited: float, payload: Any
    ) -> Status | None:
        for number, (centre, half) in enumerate(cubes):
            try:
                bound, own = self.bound(centre, half, inherited, payload)
            except OutOfTimeError:
                for rest, width in cubes[number:]:
                    self._push(inherited, width, rest, payload)
                return Status.TIME_LIMIT
            self.n_nodes += 1
            bound = max(bound, inherited)
            if bound < self.incumbent.value - self.gap_tol:
                self._push(bound, half, centre, own)
            else:
                self._pruned = min(self._pruned, bound)
        return None

    def _push(self, bound: float, half: float, centre: np.ndarray, payload: Any) -> None:
        self._serial += 1
        self.payload_bytes += _size(payload)
        heapq.heappush(self._queue, (bound, -half, self._serial, centre, payload))

    def _settle(self) -> None:
        """The global lower bound, and a row of history when a bound moved."""
        least = self._queue[0][0] if self._queue else np.inf
        # Never below an earlier one: each was valid.
        self.lower_bound = max(self.lower_bound, min(least, self._pruned, self.incumbent.value))
        last = self.trace[-1]
        now = self._row("bound")
        if (now["lower_bound"], now["upper_bound"]) != (last["lower_bound"], last["upper_bound"]):
            self.trace.append(now)

    def _limit(self) -> Status | None:
        if time.perf_counter() > self.deadline:
            return Status.TIME_LIMIT
        if self.limits.nodes is not None and self.n_nodes >= self.limits.nodes:
            return Status.NODE_LIMIT
        held = self.payload_bytes + _NODE_BYTES * len(self._queue)
        if self.limits.memory_mb is not None and held > self.limits.memory_mb * 2**20:
            return Status.MEMORY_LIMIT
        return None

    def _record(self, kind: str) -> None:
        self.trace.append(self._row(kind))

    def _row(self, kind: str) -> dict[str, Any]:
        return {
            "kind": kind,
            "stage": self.stage,
            "time_s": time.perf_counter() - self.began,
            "n_nodes": self.n_nodes,
            "n_assignments": 0,
            "n_open": len(self._queue),
            "lower_bound": self.offset + self.unit * self.lower_bound,
            "upper_bound": self.offset + self.unit * self.incumbent.value,
        }


def _size(payload: Any) -> int:
    return payload.nbytes if isinstance(payload, np.ndarray) else 0
