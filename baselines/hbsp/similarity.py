"""HBSP's bound in 2D: the rank-one matrix theta theta^T is relaxed to a semidefinite one."""

from __future__ import annotations

import numpy as np

from baselines._shared.relaxations import MinimumOverBox, SubstitutedBound
from baselines.hbsp.lifted import LiftedBox


class SemidefiniteBound(SubstitutedBound):
    """Lower bound of HBSP (reconstructed), never below that of RPM-BP on the same box."""

    def minimum_over_box(self) -> MinimumOverBox:
        lifted = LiftedBox(4)
        normal = np.zeros((5, 5))
        normal[0, 0] = 1.0
        k = float(self.space.n_inliers)

        def minimum(
            beta: np.ndarray, gamma: np.ndarray, lower: np.ndarray, upper: np.ndarray
        ) -> tuple[float, np.ndarray]:
            centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
            square = np.diag([gamma[0], gamma[0], k, k])
            square[0, 2] = square[2, 0] = square[1, 3] = square[3, 1] = 0.5 * gamma[1]
            square[0, 3] = square[3, 0] = 0.5 * gamma[2]
            square[1, 2] = square[2, 1] = -0.5 * gamma[2]
            constant = beta @ centre + centre @ square @ centre
            C = np.zeros((5, 5))
            C[0, 1:] = C[1:, 0] = half * (0.5 * beta + square @ centre)
            C[1:, 1:] = half[:, None] * square * half
            value, z = lifted.minimum(C, normal)
            return constant + value, centre + half * z

        return minimum
