"""The search for a pose with more pairs within a distance, or for the proof that there is none.

The search minimises ``most - count`` over boxes of poses, where `most` is a proven upper bound on the
count. The bound of a box is that of `dcreg.questions.kernels`. It holds for every pose, also for those
that are not stationary.

Start box
---------
For a pose with a matching P of k pairs within the distance d, t = mean(y) - L mean(x) + mean(e), with
residuals of length |e| <= d. This also holds for any k pairs of a larger matching. So t lies in the box
of the stationary poses of k pairs, extended by d on all sides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from dcreg.driver.modes import choose_mode, space_of
from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.solve import Setup
from dcreg.families.protocol import SpaceBound
from dcreg.families.region import InRegion
from dcreg.jit import is_compiled
from dcreg.names import AUTO
from dcreg.problem import Problem
from dcreg.problem.geometry import last_bits
from dcreg.questions.kernels import rigid_counts, similar_counts
from dcreg.search import (
    Box,
    Boxes,
    Budget,
    Evaluation,
    Event,
    Interrupted,
    LongestEdge,
    Tolerance,
    branch_and_bound,
)

_KERNELS = {("similarity2d", "paper"): similar_counts, ("rigid3d", "full"): rigid_counts}
_ROUNDING = 1e-9  # relative, of the distance
STAGE = "pairs"  # in events

# A pose in the units of the input -> the number of pairs within the distance
Count = Callable[[np.ndarray], int]


class CountBound(SpaceBound[Any]):
    """Bounds on `most` minus the number of pairs within `reach`."""

    def __init__(
        self, space: Any, roots: Sequence[Box], threads: int, kernel: Any, reach: float, most: int
    ) -> None:
        super().__init__(space, roots, threads)
        self.kernel, self.reach, self.most = kernel, reach, most
        self.count: Count | None = None
        self.start: np.ndarray = roots[0].centre

    @classmethod
    def of(cls, setup: Setup, budget: Budget, distance: float, most: int) -> CountBound:
        """Return the bound for the largest of the problems, in normalised units."""
        normalised = setup.normalised(-1, budget)
        kernel = _KERNELS[setup.mode.model, setup.mode.name]
        space, given = space_of(setup.mode, normalised), setup.problems[-1]
        bits = last_bits(given.source, given.target)
        reach = (distance * (1.0 + _ROUNDING) + bits) / setup.frame.unit
        roots, threads = _roots(space, reach), normalised.threads
        return cls(space, roots, threads, kernel, reach + _ROUNDING**1.5, most)

    def fresh(self) -> CountBound:
        return self

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        found, counts = Evaluation.empty(boxes), np.empty(len(boxes), np.int64)
        goal = 0 if cutoff is None else max(0, int(np.floor(self.most - cutoff)))

        def work(part: slice) -> int:
            self.kernel(
                boxes.lower[part],
                boxes.upper[part],
                self.space.clouds,
                self.reach,
                goal,
                counts[part],
            )
            return 0

        self.map_slices(len(boxes), work)
        found.lower_bounds[:] = np.maximum(self.most - counts, 0)
        found.values[:] = np.inf
        if self.count is not None and len(boxes):
            best = int(counts.argmax())
            found.values[best] = self.most - self.count(found.thetas[best])
            # the pose that is counted is kept elsewhere: near the centre, which may be inadmissible
            found.thetas[best] = self.start
        return found


def has_count_search(problem: Problem, options: SolveOptions) -> bool:
    """Tell whether numbers of pairs have a bound in this model and mode."""
    name = choose_mode(problem, options.bound) if options.mode in (None, AUTO) else options.mode
    return (problem.model, name) in _KERNELS


def count_search(
    problem: Problem, distance: float, best: tuple[np.ndarray, int], most: int, count: Count,
    settings: tuple[Limits, SolveOptions], outer: Budget,
) -> int:  # fmt: skip
    """Search for more pairs than those of the best pose.

    Parameters
    ----------
    problem : Problem
    distance : float
    best : (pose, number of pairs)
    most : int
        No pose has more pairs.
    count : callable
        Counts the pairs at a pose, and keeps the best one.
    settings : Limits, SolveOptions
    outer : Budget
        Its clock is not charged for compilation.

    Returns
    -------
    int
        No pose has more pairs.
    """
    T, known = best
    limits, options = settings
    setup = Setup.of([problem.with_n_inliers(known + 1)], limits, options)
    outer.clock.exclude(setup.time_s)
    with replace(limits, time_s=outer.left()).budget(
        options, _progress(options.listener)
    ) as budget:
        bound = CountBound.of(setup, budget, distance, most)
        space = bound.space
        if not is_compiled(bound.kernel):
            with budget.clock.paused(), outer.clock.paused(), suppress(Interrupted):
                bound.evaluate(Boxes.of(bound.roots), None)
        bound.count = lambda theta: count(setup.frame.pose(space.pose(theta)))
        bound.start = space.parameter(setup.frame.normalised_pose(T))
        found = branch_and_bound(
            bound, budget, branching=LongestEdge(space.axis_weights), tolerance=Tolerance(abs=0.5),
            start=(bound.start, most - known), stage=STAGE,
        )  # fmt: skip
    # bounds are whole numbers, up to the grid of the search
    return most - int(np.ceil(found.lower_bound - 1e-3))


def _roots(space: Any, reach: float) -> list[Box]:
    """Return the start boxes of a space, extended for poses that are not stationary."""
    if isinstance(space, InRegion):
        box = space.stationary
        vars(space)["stationary"] = Box(box.lower - reach, box.upper + reach)
        return space.roots()
    d = space.clouds.source.shape[0]
    by = reach * np.append(np.zeros(space.axis_weights.size - d), np.ones(d))
    return [Box(box.lower - by, box.upper + by) for box in space.roots()]


def _progress(listener: Any) -> Any:
    """Return a listener that receives no bounds: those of this search are numbers of pairs."""
    if listener is None:
        return None

    def listen(event: Event) -> Any:
        unknown = replace(
            event, kind="heartbeat", lower_bound=0.0, upper_bound=np.inf, expected_s=None
        )
        return listener(unknown)

    return listen
