"""The library's branch and bound over cubes divided in eight, for Go-ICP, FRS and GoTS.

Their bounds work through one cube at a time, may improve the incumbent on the way by poses that are no
centre of a cube, may run out of time within a cube, and may pass what they learnt of a cube on to its
parts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dcreg.search import Box, Budget, Evaluation, Outcome, branch_and_bound

OCTANTS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
_SHARE_OF_BOXES = 0.5  # of the memory; the rest is for what cubes pass on


class OutOfTimeError(Exception):
    """The budget was over before a step of a search knew its answer; what was found before stands."""


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


# (centre, half-width, what the parent cube passed on) -> (lower bound, what this cube passes on).
# Improves the incumbent on the way; +inf for a cube without admissible points; may raise OutOfTimeError.
CubeBound = Callable[[np.ndarray, float, Any], tuple[float, Any]]


def search_cubes(
    bound: CubeBound,
    root: tuple[np.ndarray, float],
    incumbent: Incumbent,
    budget: Budget,
    *,
    gap_tol: float,
    floor: float = 0.0,
    passed_on: np.ndarray | None = None,
) -> Outcome:
    """Minimise over a cube to within `gap_tol` of the incumbent's value.

    Parameters
    ----------
    bound : CubeBound
    root : (centre, half-width)
    incumbent : Incumbent
        Improved in place; what is found is there.
    budget : Budget
    gap_tol : float
    floor : float
        A value that the objective is never below.
    passed_on : array, optional
        Given to the bound of the root cube, and wherever the memory did not suffice to keep what a cube
        passed on.

    Returns
    -------
    Outcome
        Its theta means nothing.
    """
    memory = budget.sub_budget(1.0)
    if budget.memory_mb is not None:
        memory.memory_mb = _SHARE_OF_BOXES * budget.memory_mb
    found = branch_and_bound(
        _Cubes(bound, root, incumbent, floor, passed_on, memory.memory_mb),
        memory,
        branching=divide_in_eight,
        gap_tol=gap_tol,
        start=(root[0], incumbent.value - floor),
    )
    return with_bounds(found, lambda value: value + floor)


def with_bounds(found: Outcome, of_value: Callable[[float], float]) -> Outcome:
    """The outcome with its bounds, and those of its history, in other terms."""
    return replace(
        found,
        lower_bound=of_value(found.lower_bound),
        upper_bound=of_value(found.upper_bound),
        events=[
            replace(
                event,
                lower_bound=of_value(event.lower_bound),
                upper_bound=of_value(event.upper_bound),
            )
            for event in found.events
        ],
    )


def divide_in_eight(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(8 B, 3) octants of B boxes, those of a box next to each other."""
    middle = np.repeat(0.5 * (lower + upper), 8, axis=0)
    high = np.tile(OCTANTS > 0, (len(lower), 1))
    return (
        np.where(high, middle, np.repeat(lower, 8, axis=0)),
        np.where(high, np.repeat(upper, 8, axis=0), middle),
    )


class _Cubes:
    """A bound for single cubes, as the search asks for it: the parts of one cube in a round."""

    round_size = 1
    n_assignments = 0

    def __init__(
        self,
        bound: CubeBound,
        root: tuple[np.ndarray, float],
        incumbent: Incumbent,
        floor: float,
        passed_on: np.ndarray | None,
        memory_mb: float | None,
    ) -> None:
        centre, half = root
        self.roots = [Box(centre - half, centre + half)]
        self.bound, self.incumbent, self.floor = bound, incumbent, floor
        self._first = passed_on
        self._passed: dict[bytes, Any] = {}
        self._bytes_left = np.inf if memory_mb is None else memory_mb * 2**20

    def evaluate(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        cutoff: float | None,
        warm_start: np.ndarray | None = None,
    ) -> Evaluation:
        """Bound the parts of one cube; those that time does not suffice for keep its bound.

        The incumbent ends a bound early, not the cutoff.
        """
        bounds = np.zeros(len(lower))
        centres, halves = 0.5 * (lower + upper), 0.5 * (upper - lower).max(axis=1)
        passed_on = self._taken(lower.min(axis=0), upper.max(axis=0))
        for cube in range(len(lower)):
            try:
                value, own = self.bound(centres[cube], float(halves[cube]), passed_on)
            except OutOfTimeError:
                break
            bounds[cube] = value - self.floor
            if cutoff is None or bounds[cube] < cutoff:
                self._keep(lower[cube], upper[cube], own)
        values = np.full(len(lower), self.incumbent.value - self.floor)
        return Evaluation(bounds, centres, values)

    def _keep(self, lower: np.ndarray, upper: np.ndarray, passed_on: Any) -> None:
        if passed_on is not None and passed_on.nbytes <= self._bytes_left:
            self._bytes_left -= passed_on.nbytes
            self._passed[lower.tobytes() + upper.tobytes()] = passed_on

    def _taken(self, lower: np.ndarray, upper: np.ndarray) -> Any:
        """What the cube with these corners passed on."""
        passed_on = self._passed.pop(lower.tobytes() + upper.tobytes(), None)
        if passed_on is None:
            return self._first
        self._bytes_left += passed_on.nbytes
        return passed_on
