"""DC-Reg as its paper writes it: Algorithm 1 with the published bound, then a rotation search in 3D."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from baselines.dcreg_paper.algorithm1 import algorithm_1
from baselines.dcreg_paper.bounds import NormBound, SimilarityBound
from baselines.dcreg_paper.problem import START_BOXES, UNITS, Centred
from baselines.hbsp.rotation import SemidefiniteRotationBound
from dcreg.driver.modes import shifted_rotation
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Budget, LongestEdge, Outcome, branch_and_bound
from dcreg.status import Status

# Share of the time for the translation in 3D; the rotation search follows.
TRANSLATION_SHARE = 0.8


class Adapter(Baseline):
    """2D: the similarity. 3D: the translation in norm space, then the rotation for it."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        for option, known in (("unit", UNITS), ("start_box", START_BOXES)):
            if self.options[option] not in known:
                raise ValueError(
                    f"option {option} = {self.options[option]!r}; choose one of {', '.join(known)}"
                )
        if not isinstance(self.options["raise_children"], bool):
            raise ValueError(
                f"option raise_children = {self.options['raise_children']!r}; give true or false"
            )

    def warm_up(self, instance: Instance) -> None:
        self.solve(tiny(instance), Limits(time_s=30.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        problem = Centred.of(instance, self.options["unit"])
        epsilon = problem.epsilon(self.options["epsilon_factor"])
        with limits.budget() as budget:
            if instance.dim == 2:
                found = self._search(problem, epsilon, budget, limits.threads)
                return self._solution(problem, epsilon, [found], _similarity(found.theta))
            first = budget.sub_budget(TRANSLATION_SHARE)
            found = self._search(problem, epsilon, first, limits.threads)
            rotation = search_rotation(problem, found.theta, epsilon, budget, limits.threads)
            T = shifted_rotation(Rotation3D.matrix(rotation.theta), found.theta)
            return self._solution(problem, epsilon, [found, rotation], T)

    def _search(self, problem: Centred, epsilon: float, budget: Budget, threads: int) -> Outcome:
        space = problem.space(budget.stop)
        assert isinstance(space, Similarity2D | Translation3D)
        bound = (
            SimilarityBound(space, threads)
            if isinstance(space, Similarity2D)
            else NormBound(space, threads)
        )
        return algorithm_1(
            bound, problem.start_box(self.options["start_box"]), epsilon, budget,
            stage="search" if isinstance(space, Similarity2D) else "translation",
            raise_children=self.options["raise_children"],
        )  # fmt: skip

    def _solution(
        self, problem: Centred, epsilon: float, stages: list[Outcome], T: np.ndarray
    ) -> Solution:
        found, last, area = stages[0], stages[-1], problem.frame.area
        if not np.isfinite(found.upper_bound):
            return Solution(Status.FAILED, None, "the limit ended the search before its first box")
        # no stage proves more than the weakest one
        status = last.status if found.status is Status.OPTIMAL else found.status
        events = [event.scaled(area) for stage in stages for event in stage.events]
        scope = problem.space(np.zeros(1, np.uint8)).scope
        lower_bound = area * found.lower_bound
        return Solution(
            status, problem.frame.pose(T), "boxes " + " + ".join(str(s.n_nodes) for s in stages),
            lower_bound if np.isfinite(lower_bound) else None, area * found.upper_bound,
            area * epsilon, scope,
            {
                "n_nodes": sum(stage.n_nodes for stage in stages),
                "n_assignments": sum(stage.n_assignments for stage in stages),
            },
            [dict(vars(event)) for event in events],
        )  # fmt: skip


def search_rotation(
    problem: Centred, translation: np.ndarray, epsilon: float, budget: Budget, threads: int
) -> Outcome:
    """Find the rotation at a translation by the reconstruction of HBSP, without initial poses."""
    space = Rotation3D(
        problem.source + translation, problem.target, problem.n_inliers, stop_flag=budget.stop
    )
    bound = SemidefiniteRotationBound(space, threads=threads)
    bound.max_round = 1
    return branch_and_bound(
        bound, budget.named("rotation"), branching=LongestEdge(space.axis_weights),
        gap_tol=epsilon, stage="rotation",
    )  # fmt: skip


def _similarity(theta: np.ndarray) -> np.ndarray:
    a, b, x, y = theta
    return np.array([[a, -b, x], [b, a, y], [0.0, 0.0, 1.0]])
