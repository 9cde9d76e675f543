"""HBSP, reconstructed: semidefinite relaxation with bilinear envelopes, a small SDP for every box."""

from __future__ import annotations

import time

import numpy as np
from dcreg.rotation import Rotation3D

from baselines._relaxations import (
    SimilaritySearch,
    gap_tolerance,
    round_size,
    trace_rows,
)
from baselines.contract import Instance, Limits, Solution
from baselines.hbsp.rotation import SemidefiniteRotationBound
from baselines.hbsp.similarity import SemidefiniteBound
from dcreg.bounds import make_bound
from dcreg.local import objective, polish
from dcreg.problem import Frame, Problem
from dcreg.search import Limits as SearchLimits
from dcreg.search import LongestEdge, branch_and_bound
from dcreg.spaces import Translation3D
from dcreg.status import Status

# Share of the time limit after which the translation search must have made room for the rotation.
_TRANSLATION_SHARE = 0.5


class Adapter(SimilaritySearch):
    """2D: branch and bound over theta. 3D: DC-Reg's translation, then HBSP's search of the rotation."""

    bound = SemidefiniteBound

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        if instance.dim == 2:
            return super().solve(instance, limits)
        return self._solve_rigid(instance, limits)

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Over a box of theta in 2D; translations are not what this method bounds in 3D."""
        return super().box_bound(instance, lower, upper) if instance.dim == 2 else np.nan

    def _solve_rigid(self, instance: Instance, limits: Limits) -> Solution:
        began = time.perf_counter()
        gap_tol = gap_tolerance(instance, self.options["gap_tol_factor"])
        k = instance.n_inliers
        problem = Problem(instance.source, instance.target, k, "rigid3d", (1.0, 1.0))
        frame = Frame.of(problem)
        area = frame.unit**2
        source, target = frame.source(problem.source), frame.target(problem.target)

        def left(share: float) -> SearchLimits:
            spent = time.perf_counter() - began
            return SearchLimits(
                max(0.0, share * limits.time_s - spent), limits.nodes, limits.memory_mb
            )

        space = Translation3D(source, target, k)
        theta, value, spent = space.first_incumbent()
        moved = branch_and_bound(
            make_bound("tight", space, limits.threads),
            [space.start_box()],
            branching=LongestEdge(space.axis_weights),
            gap_tol=gap_tol / area,
            refine=space.refine,
            start=(theta, value),
            limits=left(_TRANSLATION_SHARE),
            round_size=round_size(len(source) * len(target)),
        )
        model = Rotation3D(source + moved.theta, target, k)
        theta, value, spent_turning = model.start(left(1.0).time_s)
        offset = time.perf_counter() - began
        turned = branch_and_bound(
            SemidefiniteRotationBound(model),
            model.roots(),
            branching=LongestEdge(np.ones(4)),
            gap_tol=gap_tol / area,
            refine=model.refine,
            start=(theta, value),
            limits=left(1.0),
            round_size=round_size(len(source) * len(target)),
            stage="rotation",
        )
        T = np.eye(4)
        T[:3, :3] = model.matrix(turned.theta)
        T[:3, 3] = T[:3, :3] @ moved.theta
        pose = frame.pose(T)
        certified, _ = objective(problem.source, problem.target, pose, k)
        final = certified
        if self.options["polish"]:
            pose, final, _, _ = polish(problem.source, problem.target, pose, k, (1.0, 1.0))
        return Solution(
            turned.status if moved.status is Status.OPTIMAL else moved.status,
            pose,
            lower_bound=turned.lower_bound * area,
            upper_bound=turned.upper_bound * area,
            gap_tol=gap_tol,
            certificate_scope="rotation about the translation found in norm space",
            counters={
                "n_nodes": moved.n_nodes + turned.n_nodes,
                "n_assignments": moved.n_assignments + turned.n_assignments + spent + spent_turning,
            },
            trace=trace_rows(moved.events, area) + trace_rows(turned.events, area, offset),
            extra={"objective": final, "objective_certified": certified},
        )
