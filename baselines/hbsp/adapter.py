"""HBSP, reconstructed: semidefinite relaxation with bilinear envelopes, a small SDP for every box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from baselines._shared.library_search import OwnBound
from baselines.contract import Instance
from baselines.hbsp.rotation import SemidefiniteRotationBound
from baselines.hbsp.similarity import SemidefiniteBound
from dcreg.driver.modes import find_mode
from dcreg.driver.normalised import NormalisedProblem, Solution
from dcreg.families.dc.space import FeatureSpace
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

    def run(self, problem: NormalisedProblem) -> Solution:
        return super().run(problem) if problem.dim == 2 else translate_and_rotate(problem)

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Over a box of theta in 2D; translations are not what this method bounds in 3D."""
        return super().box_bound(instance, lower, upper) if instance.dim == 2 else np.nan


def translate_and_rotate(problem: NormalisedProblem) -> Solution:
    """Search the translation in norm space by DC-Reg's tight bound, then the rotation by HBSP's."""
    mode = replace(find_mode("rigid3d", "paper"), rotation=search_rotation)
    solution = mode.run(replace(problem, bound="tight"))
    rotation = solution.stages[-1]
    assert rotation.lower_bound is not None
    assert rotation.upper_bound is not None
    return replace(
        solution, lower_bound=rotation.lower_bound, upper_bound=rotation.upper_bound,
        scope=SCOPE_3D, certified=None,
    )  # fmt: skip


def search_rotation(problem: NormalisedProblem, shifted: np.ndarray, budget: Budget) -> Outcome:
    """Find the best rotation of the shifted source by HBSP's bound."""
    space = Rotation3D(shifted, problem.target, problem.n_inliers, stop_flag=budget.stop)
    bound = SemidefiniteRotationBound(space, threads=problem.threads)
    return minimise(space, bound, budget, gap_tol=problem.gap_tol, stage="rotation")
