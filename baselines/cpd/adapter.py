"""Coherent point drift with pycpd: a Gaussian mixture moved rigidly, or by a similarity in 2D."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from baselines._shared.poses import homogeneous, unit_of
from baselines._shared.starts import STARTS, best_of_starts, check_choice
from baselines.contract import Baseline, Card, Instance, Limits, Solution
from dcreg.problem import apply_pose, scale_of
from dcreg.search import Budget


class Adapter(Baseline):
    """pycpd's rigid registration with the scale clipped to the range of the instance."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self.starts = check_choice(self, "starts", STARTS)

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        # The uniform component of the mixture assumes coordinates of order one: use target RMS radii
        # about the centroid of the target.
        unit = unit_of(instance)
        origin = instance.target.mean(axis=0)
        normalise = homogeneous(1 / unit, np.eye(instance.dim), -origin / unit)
        target = apply_pose(normalise, instance.target)

        def refine(pose: np.ndarray, budget: Budget) -> np.ndarray | None:
            start_scale = scale_of(pose)
            drift = _bounded_rigid()(
                scale_range=np.array(instance.scale_range) / start_scale,
                X=target,
                Y=apply_pose(normalise @ pose, instance.source),
                w=self._outlier_weight(instance),
                max_iterations=self.options["max_iterations"],
                tolerance=self.options["tolerance"],
            )
            try:
                while drift.iteration < drift.max_iterations and drift.diff > drift.tolerance:
                    drift.iterate()
                    if budget.is_over:
                        break
            except np.linalg.LinAlgError:  # no source point explains any target point
                return None
            found = homogeneous(drift.s, drift.R.T, np.ravel(drift.t))
            moved = np.linalg.inv(normalise) @ found @ normalise @ pose
            return moved if np.isfinite(moved).all() else None

        with np.errstate(all="ignore"):  # a collapsing mixture underflows before it returns None
            return best_of_starts(instance, self.starts, limits, refine)

    def _outlier_weight(self, instance: Instance) -> float:
        """Return the option, or the share of the target that `n_inliers` leaves unmatched."""
        if self.options["w"] is not None:
            return float(self.options["w"])
        return float(np.clip(1 - instance.n_inliers / len(instance.target), 0.1, 0.9))


@functools.cache
def _bounded_rigid() -> type:
    from pycpd import RigidRegistration

    class BoundedRigid(RigidRegistration):
        """Rigid registration of pycpd with the scale in a range; a single value fixes it."""

        s: float
        q: float
        sigma2: float

        def __init__(self, scale_range: np.ndarray, **settings: Any) -> None:
            super().__init__(**settings)
            self.scale_range = scale_range

        def update_transform(self) -> None:
            super().update_transform()
            self.s = float(np.clip(self.s, *self.scale_range))
            mean_target = self.Pt1 @ self.X / self.Np
            mean_source = self.P1 @ self.Y / self.Np
            self.t = mean_target - self.s * mean_source @ self.R

        def update_variance(self) -> None:
            # pycpd's short formula holds only at the optimal scale, this one at every scale.
            last = self.q
            overlap = float(np.trace(self.A @ self.R))
            spread = float(self.Pt1 @ (self.X_hat**2).sum(axis=1))
            residual = spread - 2 * self.s * overlap + self.s**2 * self.YPY
            self.q = residual / (2 * self.sigma2) + self.D * self.Np / 2 * np.log(self.sigma2)
            self.diff = abs(self.q - last)
            self.sigma2 = residual / (self.Np * self.D)
            if not self.sigma2 > 0:
                self.sigma2 = self.tolerance / 10

    return BoundedRigid
