"""HBSP, reconstructed: semidefinite relaxation with bilinear envelopes, a small SDP for every box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from baselines._shared.library_search import OwnBound
from baselines.contract import Instance
from baselines.hbsp.rotation import SemidefiniteRotationBound
from baselines.hbsp.similarity import SemidefiniteBound
from dcreg.driver import paper
from dcreg.driver.task import Answer, Task
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.registry import make_bound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Bound, Box, Budget, Outcome, minimise

SCOPE_3D = "rotation about the translation found in norm space"


class Adapter(OwnBound):
    """2D: branch and bound over theta. 3D: DC-Reg's translation, then HBSP's search of the rotation."""

    own_bound = "hbsp"

    def make_bound(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> Bound:
        return SemidefiniteBound(space, roots, threads)

    def run(self, task: Task) -> Answer:
        return super().run(task) if task.dim == 2 else translate_and_turn(task)

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Over a box of theta in 2D; translations are not what this method bounds in 3D."""
        return super().box_bound(instance, lower, upper) if instance.dim == 2 else np.nan


def translate_and_turn(task: Task) -> Answer:
    """The translation of norm space by DC-Reg's tight bound, then the rotation about it by HBSP's."""
    answer = paper.run(task, partial(make_bound, "tight"), turn)
    rotation = answer.stages[-1]
    assert rotation.lower_bound is not None
    assert rotation.upper_bound is not None
    return replace(
        answer, lower_bound=rotation.lower_bound, upper_bound=rotation.upper_bound,
        scope=SCOPE_3D, cover=None,
    )  # fmt: skip


def turn(task: Task, shifted: np.ndarray, budget: Budget) -> Outcome:
    """The best rotation of the shifted source, by HBSP's bound."""
    space = Rotation3D(shifted, task.target, task.n_inliers, stop_flag=budget.stop)
    bound = SemidefiniteRotationBound(space, threads=task.threads)
    return minimise(space, bound, budget, gap_tol=task.gap_tol, stage="rotation")
