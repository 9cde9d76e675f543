"""The library's branch and bound over cubes divided into octants, for Go-ICP, FRS and GoTS.

Their bounds process one cube at a time. They may improve the incumbent by any pose, may run out of time
within a cube, and may pass data of a cube on to its octants.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dcreg.search import Box, Boxes, Budget, Evaluation, Outcome, Tolerance, branch_and_bound

OCTANTS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
_SHARE_OF_BOXES = 0.5  # of the memory; the rest is for data that cubes pass on


class OutOfTimeError(Exception):
    """The budget was over before a step of a search had a result; earlier results remain valid."""


@dataclass
class Incumbent:
    """The minimum value of the objective so far, and its pose."""

    value: float = np.inf
    pose: Any = None

    def offer(self, value: float, pose: Any) -> bool:
        """Keep the pose if it is better; return whether it is."""
        if value < self.value:
            self.value, self.pose = float(value), pose
            return True
        return False


# (centre, half-width, data of the parent cube) -> (lower bound, data for the octants). May improve the
# incumbent and raise OutOfTimeError; the bound is +inf for a cube without admissible points.
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
        Improved in place; holds the best pose afterwards.
    budget : Budget
    gap_tol : float
    floor : float
        A lower bound of the objective.
    passed_on : array, optional
        Data for the root cube, and for cubes whose parent's data did not fit into the memory.

    Returns
    -------
    Outcome
        Its theta has no meaning.
    """
    memory = budget.sub_budget(1.0)
    if budget.memory_mb is not None:
        memory.memory_mb = _SHARE_OF_BOXES * budget.memory_mb
    found = branch_and_bound(
        _Cubes(bound, root, incumbent, floor, passed_on, memory.memory_mb),
        memory,
        branching=divide_in_eight,
        tolerance=Tolerance(abs=gap_tol),
        start=(root[0], incumbent.value - floor),
    )
    return with_bounds(found, lambda value: value + floor)


def with_bounds(found: Outcome, of_value: Callable[[float], float]) -> Outcome:
    """Return the outcome with all bounds converted by `of_value`."""
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


def divide_in_eight(boxes: Boxes) -> Boxes:
    """Return the 8 B octants of B boxes; the octants of a box are adjacent."""
    octants, high = boxes.repeated(8), np.tile(OCTANTS > 0, (len(boxes), 1))
    centres = octants.centres
    octants.lower[high], octants.upper[~high] = centres[high], centres[~high]
    return octants


class _Cubes:
    """Adapt a `CubeBound` to the search: a round bounds the octants of one cube."""

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

    def fresh(self) -> _Cubes:
        """Return the bound itself: its searches never ask how long a proof takes."""
        return self

    def evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        """Bound the octants of one cube; octants after the time limit keep the bound of the cube.

        A bound stops early by the incumbent, not by the cutoff.
        """
        lower, upper, centres = boxes.lower, boxes.upper, boxes.centres
        bounds, halves = np.zeros(len(boxes)), 0.5 * (upper - lower).max(axis=1)
        passed_on = self._taken(lower.min(axis=0), upper.max(axis=0))
        for cube in range(len(boxes)):
            try:
                value, own = self.bound(centres[cube], float(halves[cube]), passed_on)
            except OutOfTimeError:
                break
            bounds[cube] = value - self.floor
            if cutoff is None or bounds[cube] < cutoff:
                self._keep(lower[cube], upper[cube], own)
        values = np.full(len(boxes), self.incumbent.value - self.floor)
        return Evaluation(bounds, centres, values)

    def _keep(self, lower: np.ndarray, upper: np.ndarray, passed_on: Any) -> None:
        if passed_on is not None and passed_on.nbytes <= self._bytes_left:
            self._bytes_left -= passed_on.nbytes
            self._passed[lower.tobytes() + upper.tobytes()] = passed_on

    def _taken(self, lower: np.ndarray, upper: np.ndarray) -> Any:
        """Return the data of the cube with these vertices."""
        passed_on = self._passed.pop(lower.tobytes() + upper.tobytes(), None)
        if passed_on is None:
            return self._first
        self._bytes_left += passed_on.nbytes
        return passed_on
