"""HBSP, reconstructed: semidefinite relaxation with bilinear envelopes; one small SDP per box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from baselines._shared.algorithm1 import Bounding
from baselines._shared.own_search import EitherSearch
from baselines._shared.published import NormBound
from baselines._shared.relaxations import Relaxation
from baselines.contract import Instance, Limits, Solution
from baselines.hbsp.rotation import SemidefiniteRotationBound, rotation_alone
from baselines.hbsp.similarity import SemidefiniteBound
from dcreg.families.mode import Mode
from dcreg.families.registry import make_bound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box, Budget, Outcome, Tolerance, minimise

SCOPE_3D = "rotation about the translation found in norm space"


class Adapter(EitherSearch):
    """2D: branch and bound over theta. 3D: DC-Reg's translation search, then HBSP's rotation search."""

    own_bound = "hbsp"

    def relaxations(
        self, space: Any, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> list[Relaxation[Any]]:
        return [SemidefiniteBound(space, roots, threads)]

    def bounding(self, space: Any, threads: int) -> Bounding:
        """The paper of DC-Reg joins its translation search to HBSP's rotation search."""
        if isinstance(space, Translation3D):
            return NormBound(space, threads)
        return super().bounding(space, threads)

    def make_rotation(self, space: Rotation3D, threads: int) -> Bounding:
        return rotation_alone(space, threads, self.options["incumbents"] == "fit")

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        if instance.dim == 2 or self.options["search"] == "ours":
            return super().solve(instance, limits)
        found = self.search_alone(instance, limits)
        return replace(found, scope=SCOPE_3D).solution(certified=1)

    def mode(self, model: str) -> Mode:
        mode = super().mode(model)
        if model == "similarity2d":
            return mode
        return replace(
            mode, make_bound=partial(make_bound, "tight"), rotation=search_rotation,
            rotation_scope=SCOPE_3D, in_norm_space=False,
        )  # fmt: skip

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Return the bound over a box of theta in 2D; in 3D the method bounds no translations."""
        return super().box_bound(instance, lower, upper) if instance.dim == 2 else np.nan


def search_rotation(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    candidates: None,
    *,
    tolerance: Tolerance,
    threads: int,
    budget: Budget,
) -> Outcome:
    """Find the best rotation about the origin by HBSP's bound."""
    space = Rotation3D(source, target, n_inliers, candidates, budget.stop)
    bound = SemidefiniteRotationBound(space, threads=threads)
    budget = budget.named("start of rotation")
    return minimise(space, bound, budget, tolerance=tolerance, stage="rotation")
