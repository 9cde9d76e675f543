"""Separate searches of methods that bound boxes of poses, without the search of this library.

The loop is Algorithm 1 (`baselines._shared.algorithm1`), from one start box to an absolute tolerance. The
only incumbents are candidates of the bounds. There are no initial poses, no pair hypotheses, no local
searches and no polish, and no box is pruned for its scales. In 3D the translation is searched in norm
space, and then the rotation for this translation.

Details that the papers leave open are options here, the same for all methods (`OPTIONS`).
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from baselines._shared.algorithm1 import Bounding, algorithm_1
from baselines._shared.centred import START_BOXES, UNITS, Centred
from baselines._shared.library_search import OwnBound
from baselines._shared.relaxations import Relaxation, SingleBoxes
from baselines.contract import Baseline, Card, Instance, Limits, Solution
from dcreg.driver.modes import shifted_rotation
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import Strongest
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Bound, Box, Outcome
from dcreg.status import Status

# Share of the time for the translation in 3D; the rotation search follows.
TRANSLATION_SHARE = 0.8
# Point pairs in 3D above which the rotation search does not fit into the memory of a common machine.
MAX_PAIRS = 1_000_000

CHOICES = {
    "search": ("own", "ours"),
    "unit": UNITS,
    "start_box": START_BOXES,
    "incumbents": ("fit", "pose"),
}
OPTIONS = ("epsilon_factor", "start_box", "unit", "incumbents", "raise_children")

# (space, threads) -> the bound of a method over boxes of that space
MakeBounding = Callable[[Any, int], Bounding]


def check_options(method: Baseline) -> None:
    """Refuse unknown values of the options of a separate search.

    Raises
    ------
    ValueError
    """
    for option, known in CHOICES.items():
        value = method.options.get(option, known[0])  # DC-Reg has neither search nor incumbents
        if value not in known:
            raise ValueError(f"option {option} = {value!r}; choose one of {', '.join(known)}")
    raised = method.options["raise_children"]
    if not isinstance(raised, bool):
        raise ValueError(f"option raise_children = {raised!r}; give true or false")


def too_large(instance: Instance) -> str | None:
    """Return why the rotation search cannot treat an instance, or None."""
    n, m = len(instance.source), len(instance.target)
    if instance.dim == 2 or n * m <= MAX_PAIRS:
        return None
    return (
        f"{n} x {m} point pairs exceed {MAX_PAIRS:,}: the rotation search needs several numbers for "
        "each; sample the clouds (n_points of a method)"
    )


@dataclass(frozen=True)
class Found:
    """The stages of a separate search, in normalised units, and the normalised pose."""

    problem: Centred
    epsilon: float
    stages: list[Outcome]
    T: np.ndarray
    scope: str

    def solution(self, certified: int = 0) -> Solution:
        """Return the result in the units of the instance, with the bounds of one stage."""
        first, last, area = self.stages[0], self.stages[-1], self.problem.frame.area
        if not np.isfinite(first.upper_bound):
            return Solution(Status.FAILED, None, "the limit ended the search before its first box")
        # no stage proves more than the weakest one
        status = last.status if first.status is Status.OPTIMAL else first.status
        lower_bound, upper_bound = (
            area * value if np.isfinite(value) else None
            for value in (self.stages[certified].lower_bound, self.stages[certified].upper_bound)
        )
        names = ("translation", "rotation") if len(self.stages) > 1 else ("search",)
        boxes = [stage.n_nodes for stage in self.stages]
        return Solution(
            status, self.problem.frame.pose(self.T), "boxes " + " + ".join(map(str, boxes)),
            lower_bound, upper_bound, area * self.epsilon,
            self.scope,
            {
                "n_nodes": sum(boxes),
                "n_assignments": sum(stage.n_assignments for stage in self.stages),
            },
            [vars(event.scaled(area)) for stage in self.stages for event in stage.events],
            {
                f"{number}_{name}": float(getattr(stage, number))
                for name, stage in zip(names, self.stages, strict=True)
                for number in ("n_nodes", "n_assignments", "time_s")
            }
            | {
                f"is_optimal_{name}": float(stage.status is Status.OPTIMAL)
                for name, stage in zip(names, self.stages, strict=True)
            },
        )  # fmt: skip


def search_alone(
    instance: Instance,
    limits: Limits,
    options: Mapping[str, Any],
    make: MakeBounding,
    make_rotation: MakeBounding,
) -> Found:
    """Search a similarity in 2D; in 3D a translation in norm space, then the rotation for it.

    Parameters
    ----------
    instance : Instance
    limits : Limits
    options : mapping
        Values of `OPTIONS`.
    make : callable
        Returns the bound of the method over the space of the first stage.
    make_rotation : callable
        The same for the rotation in 3D.
    """
    problem = Centred.of(instance, options["unit"])
    epsilon, threads = problem.epsilon(options["epsilon_factor"]), limits.threads
    raised: bool = options["raise_children"]
    with limits.budget() as budget:
        space = problem.space(budget.stop)
        roots = [problem.start_box(options["start_box"])]
        scope = space.scope + (", in the start box" if options["start_box"] == "extent" else "")
        if instance.dim == 2:
            found = algorithm_1(make(space, threads), roots, epsilon, budget, raise_children=raised)
            return Found(problem, epsilon, [found], space.pose(found.theta), scope)
        found = algorithm_1(
            make(space, threads), roots, epsilon, budget.sub_budget(TRANSLATION_SHARE),
            stage="translation", raise_children=raised,
        )  # fmt: skip
        turning = Rotation3D(
            problem.source + found.theta, problem.target, problem.n_inliers, stop_flag=budget.stop
        )
        rotation = algorithm_1(
            make_rotation(turning, threads), turning.roots(), epsilon, budget,
            stage="rotation", raise_children=raised,
        )  # fmt: skip
        T = shifted_rotation(Rotation3D.matrix(rotation.theta), found.theta)
        return Found(problem, epsilon, [found, rotation], T, scope)


class EitherSearch(OwnBound):
    """A bound over boxes of poses, in a separate search or in that of the library (``search``)."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        check_options(self)

    def idle_options(self) -> dict[str, str]:
        own = self.options["search"] == "own"
        idle = dict.fromkeys(
            ("polish",) if own else OPTIONS, f"with search: {self.options['search']}"
        )
        return {**super().idle_options(), **idle}

    @abc.abstractmethod
    def relaxations(
        self, space: Any, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> list[Relaxation[Any]]:
        """Return the relaxations whose maximum is the method's bound."""

    def make_bound(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> Bound:
        parts = self.relaxations(space, roots, threads)
        return parts[0] if len(parts) == 1 else Strongest(parts)

    def bounding(self, space: Any, threads: int) -> Bounding:
        """Return the bound in the form of the separate search."""
        fits = self.options["incumbents"] == "fit"
        return SingleBoxes(self.relaxations(space, threads=threads), fits)

    def make_rotation(self, space: Rotation3D, threads: int) -> Bounding:
        """Return the bound of the rotation search in 3D."""
        raise NotImplementedError

    def supports(self, instance: Instance) -> str | None:
        own = self.options["search"] == "own"
        return super().supports(instance) or (too_large(instance) if own else None)

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        if self.options["search"] == "ours":
            return super().solve(instance, limits)
        return self.search_alone(instance, limits).solution()

    def search_alone(self, instance: Instance, limits: Limits) -> Found:
        """Run the separate search."""
        return search_alone(instance, limits, self.options, self.bounding, self.make_rotation)
