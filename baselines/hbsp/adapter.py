"""HBSP, reconstructed: semidefinite relaxation with bilinear envelopes, a small SDP for every box."""

from __future__ import annotations

import numpy as np

from baselines._shared.relaxations import SimilaritySearch
from baselines.contract import Instance
from baselines.hbsp.rotation import SemidefiniteRotationBound
from baselines.hbsp.similarity import SemidefiniteBound
from dcreg.bounds import make_bound
from dcreg.modes import Answer, Task
from dcreg.search import minimise
from dcreg.spaces import Rotation3D, Translation3D
from dcreg.status import Status

# Share of the time limit after which the translation search must have made room for the rotation.
_TRANSLATION_SHARE = 0.5
SCOPE_3D = "rotation about the translation found in norm space"


class Adapter(SimilaritySearch):
    """2D: branch and bound over theta. 3D: DC-Reg's translation, then HBSP's search of the rotation."""

    bound = SemidefiniteBound

    def run(self, task: Task) -> Answer:
        return super().run(task) if task.dim == 2 else translate_and_turn(task)

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Over a box of theta in 2D; translations are not what this method bounds in 3D."""
        return super().box_bound(instance, lower, upper) if instance.dim == 2 else np.nan


def translate_and_turn(task: Task) -> Answer:
    """The translation of norm space by DC-Reg's tight bound, then the rotation about it by HBSP's."""
    norms = Translation3D(task.source, task.target, task.n_inliers)
    moved = minimise(
        norms, make_bound("tight", norms, threads=task.threads),
        task.budget.part(_TRANSLATION_SHARE), gap_tol=task.gap_tol,
    )  # fmt: skip
    space = Rotation3D(task.source + moved.theta, task.target, task.n_inliers)
    turned = minimise(
        space, SemidefiniteRotationBound(space), task.budget, gap_tol=task.gap_tol,
        stage="rotation",
    )  # fmt: skip
    T = space.pose(turned.theta)
    T[:3, 3] = T[:3, :3] @ moved.theta
    status = turned.status if moved.status is Status.OPTIMAL else moved.status
    answer = Answer(T, status, turned.lower_bound, turned.upper_bound, SCOPE_3D)
    answer.add("search", moved)
    answer.add("rotation", turned)
    return answer
