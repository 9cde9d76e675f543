"""Rotations about the origin: the second stage of mode `paper` in 3D.

For points a_i (the translation is already applied), y_j and k pairs the problem is

    min over R in SO(3) and one-to-one P of k pairs of  E_P(R) = sum_ij p_ij |R a_i - y_j|^2,

a rotation about the origin, without centring.

Why boxes of quaternions
------------------------
theta is a quaternion (w, x, y, z) of any length. The eight facets of the cube [-1, 1]^4 contain each
quaternion once up to length. Since q and -q are the same rotation, the four facets on which one
component is +1 contain every rotation, and only those on their boundaries more than once. They are the
roots. A box has zero width along its facet's axis, is never divided along it, and needs no index of
its facet. Both bounds apply to such boxes directly. The cube of angle-axis vectors would waste 48 % of
its volume outside the ball of radius pi, cover half-turns twice, and need an enclosure by such a box
for B2.
"""

from __future__ import annotations

import abc

import numpy as np

from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.protocol import Space
from dcreg.families.rotation3d.kernels import rotation as kernels
from dcreg.families.rotation3d.kernels.geometry import best_rotation, rotation_matrix
from dcreg.search import Box


class CloudSpace(Space):
    """A space of poses of 3D points."""

    min_gain = 1e-12

    @abc.abstractmethod
    def fit(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the best parameter for paired points, (3, k) each."""

    def matched(self, col_of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the matched points of both clouds, (3, k) each."""
        rows = np.flatnonzero(col_of >= 0)
        return self.clouds.source[:, rows], self.clouds.target[:, col_of[rows]]

    def fit_matching(self, theta: np.ndarray, col_of: np.ndarray) -> np.ndarray:
        return self.fit(*self.matched(col_of))


_START_CELLS_PER_AXIS = 4  # of the regular grid of seeds


class Rotation3D(CloudSpace):
    """Rotations about the origin; theta is a quaternion (w, x, y, z) of any non-zero length."""

    axis_weights = np.ones(4)
    scope = "rotation about the origin"
    n_descents = 8

    @staticmethod
    def roots() -> list[Box]:
        """Return the facets w, x, y, z = 1 of the cube [-1, 1]^4, which contain every rotation."""
        boxes = []
        for axis in range(4):
            lower = -np.ones(4)
            lower[axis] = 1.0
            boxes.append(Box(lower, np.ones(4)))
        return boxes

    @staticmethod
    def grid(cells: int) -> np.ndarray:
        """Return (4 cells^3, 4) quaternions: the centres of a regular division of the four facets."""
        steps = (2.0 * np.arange(cells) + 1.0) / cells - 1.0
        facet = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.concatenate([np.insert(facet, axis, 1.0, axis=1) for axis in range(4)])

    def seeds(self) -> np.ndarray:
        return self.grid(_START_CELLS_PER_AXIS)

    def score(self, seeds: np.ndarray) -> tuple[np.ndarray, int]:
        """Score by nearest neighbours, without an assignment."""
        scores = np.empty(len(seeds))
        kernels.nearest_scores(seeds, self.clouds, scores)
        return scores, 0

    @staticmethod
    def matrix(theta: np.ndarray) -> np.ndarray:
        """Return the rotation matrix of a quaternion; theta, -theta and 2 theta give the same one."""
        return rotation_matrix(np.asarray(theta, dtype=np.float64))

    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        cost = np.empty((self.n_source, self.n_target))
        R = self.matrix(theta)
        kernels.pair_costs(R, self.clouds, cost)
        _, col_of, _ = cheapest_pairs(cost, self.n_inliers, self.stop_flag)
        self.check()
        # summed again: the expanded squares of `pair_costs` cancel and may leave a tiny negative sum
        x, y = self.matched(col_of)
        return float(((R @ x - y) ** 2).sum()), col_of

    def fit(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return best_rotation(source, target)

    def normalised(self, theta: np.ndarray) -> np.ndarray:
        return theta / theta[np.argmax(np.abs(theta))]

    def pose(self, theta: np.ndarray) -> np.ndarray:
        """Return the (4, 4) matrix of the rotation."""
        T = np.eye(4)
        T[:3, :3] = self.matrix(theta)
        return T
