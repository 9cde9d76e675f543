"""Similarities in 3D: rotation, translation and scale.

For points x_i, y_j and k pairs the problem is

    min over R in SO(3), t in R^3, s in [low, high] and one-to-one P of k pairs of
        sum_ij p_ij |s R x_i + t - y_j|^2.

theta is a quaternion of any length, the translation t and the scale s.

Start box
---------
For fixed pairs the best t is mean(y) - s R mean(x). An optimum therefore has a translation within the
range of the means of any k targets, extended by the maximum length of the mean of any k sources times
the maximum scale.

All points match
----------------
If k = n = m and both clouds are centred, t is 0 and the objective is

    S_yy + s^2 S_xx - 2 s G,    G = sum_ij p_ij y_j . R x_i,

where S_xx and S_yy are the sums of squared norms. The best rotation and matching maximise G, whatever
the scale. So they are those of the rigid problem at any fixed scale, and the best scale is G / S_xx,
clipped to the range. Only rotations are then searched; boxes are never divided along the scale. With
weights or attributes this does not hold, because the best matching then depends on the scale.
"""

from __future__ import annotations

import math
from typing import Any, Self

import numpy as np

from dcreg.families.rigid3d.kernels.poses import nearest_scores, pose_costs
from dcreg.families.rigid3d.space import Poses3D
from dcreg.families.rigid3d.starts import SCALES, rounds_for
from dcreg.families.rotation3d.kernels.geometry import best_rotation, rotation_matrix
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.similarity3d.starts import MAX_TARGETS, N_TRIPLES, similar_poses_3d
from dcreg.jit import NEVER
from dcreg.names import SIMILARITY_POSE
from dcreg.problem import PairWeights
from dcreg.problem.geometry import fit_pose
from dcreg.search import Box

SCALE = 7  # place of the scale in a parameter
_SCALE_STEP = 1.15  # ratio of the scales of neighbouring seeds
_SCALE_REACH = 3.0  # maximum ratio of the scale of a seed to that of equal spreads


def fit_similarity(
    source: np.ndarray, target: np.ndarray, scale_range: tuple[float, float]
) -> np.ndarray:
    """Return the best parameter of paired (3, k) points.

    Clipping the scale is exact: the best rotation does not depend on the scale, and the objective is a
    parabola in the scale.
    """
    mean_x, mean_y = source.mean(axis=1), target.mean(axis=1)
    x, y = source - mean_x[:, None], target - mean_y[:, None]
    rotation = best_rotation(x, y)
    turned = rotation_matrix(rotation) @ x
    spread, (low, high) = float((x * x).sum()), scale_range
    scale = float((turned * y).sum()) / spread if spread > 0.0 else low
    scale = min(max(scale, low), high)
    shift = mean_y - scale * (rotation_matrix(rotation) @ mean_x)
    return np.concatenate([rotation, shift, [scale]])


class Similarity3D(Poses3D):
    """Similarities of centred clouds; theta is a quaternion, a translation and a scale.

    Parameters
    ----------
    source, target, n_inliers, candidates, stop_flag, stationary_box
        As in `Space`.
    scale_range : (low, high)

    Attributes
    ----------
    spread : float
        RMS norm of the source points.
    usual_scale : float
        The scale at which both clouds have the same spread, clipped to the range.
    only_rotates : bool
        Whether all points of both clouds are matched, the clouds are centred, and there are no weights.
    """

    scope = SIMILARITY_POSE

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        scale_range: tuple[float, float],
        candidates: np.ndarray | None = None,
        stop_flag: np.ndarray = NEVER,
        stationary_box: bool = True,
    ) -> None:
        super().__init__(
            source, target, n_inliers, candidates, stop_flag, stationary_box, scale_range[1]
        )
        self.scale_range, self.max_scale = scale_range, scale_range[1]
        squares = (self.clouds.source**2).sum(axis=0), (self.clouds.target**2).sum(axis=0)
        self.spread = max(math.sqrt(squares[0].mean()), 1e-12)
        low, high = scale_range
        self.usual_scale = min(max(math.sqrt(squares[1].mean()) / self.spread, low), high)
        box = self.translations()
        self.only_rotates = n_inliers == self.n_source == self.n_target and not (
            box.lower.any() or box.upper.any()
        )
        # as in `Rigid3D`, for a source of this size
        turn = 1.3 * self.spread * self.usual_scale
        scale = 0.0 if self.only_rotates else self.spread
        self.axis_weights = np.array([turn, turn, turn, turn, 1.0, 1.0, 1.0, scale])

    def weighted(self, weights: PairWeights) -> Self:
        """Set the weights of pairs; the best rotation then depends on the scale."""
        self.only_rotates, self.axis_weights[SCALE] = False, self.spread
        return super().weighted(weights)

    def roots(self) -> list[Box]:
        """Return boxes that together contain every optimum."""
        box, (low, high) = self.translations(), self.scale_range
        return [
            Box(
                np.concatenate([facet.lower, box.lower, [low]]),
                np.concatenate([facet.upper, box.upper, [high]]),
            )
            for facet in Rotation3D.roots()
        ]

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        low, high = self.scale_range
        scale = thetas[:, SCALE]
        return (scale >= low * (1.0 - 1e-12)) & (scale <= high * (1.0 + 1e-12))

    def _costs(self, theta: np.ndarray) -> np.ndarray:
        cost = np.empty((self.n_source, self.n_target))
        pose_costs(theta[:SCALE], self._scaled(theta[SCALE]), cost)
        return cost

    def _scaled(self, scale: float) -> Any:
        """Return the clouds after the source is scaled."""
        return self.clouds._replace(source=scale * self.clouds.source)

    def fit(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the best parameter of paired (3, k) points, with its scale in the range."""
        return fit_similarity(source, target, self.scale_range)

    def fit_pairs(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return fit_pose(source, target, self.scale_range)

    def of_points(self, source: np.ndarray, target: np.ndarray, n_inliers: int) -> Similarity3D:
        """Return the same space over other points, without candidates."""
        return Similarity3D(
            source, target, n_inliers, self.scale_range, None, self.stop_flag, self.stationary_box
        )

    def _poses_of_triples(self, seed: int) -> np.ndarray:
        return similar_poses_3d(
            self.clouds.source.T, self.clouds.target.T, self.scale_range,
            SCALES[seed % len(SCALES)], self.candidates, seed=seed, stop=self.stop_flag,
        )  # fmt: skip

    def _rounds(self, failure: float) -> int:
        return rounds_for(
            self.n_source, self.n_target, self.n_inliers, failure,
            n_triples=N_TRIPLES, max_targets=MAX_TARGETS,
        )  # fmt: skip

    @staticmethod
    def _vertices(theta: np.ndarray) -> np.ndarray:
        """Return the (12,) coordinates of the moved vertices of a unit tetrahedron."""
        R, t = rotation_matrix(np.asarray(theta[:4], dtype=np.float64)), theta[4:SCALE]
        return np.concatenate([t, *(theta[SCALE] * R.T + t)])

    def _seed_scales(self) -> np.ndarray:
        """Return scales of seeds, evenly spaced by their ratio."""
        usual, (low, high) = self.usual_scale, self.scale_range
        if self.only_rotates or low == high:
            return np.array([usual])
        low, high = max(low, usual / _SCALE_REACH), min(high, usual * _SCALE_REACH)
        count = 1 + math.ceil(math.log(high / low) / math.log(_SCALE_STEP))
        return np.geomspace(low, high, count)

    def seeds(self) -> np.ndarray:
        scales = self._seed_scales()
        poses = self._regular_poses(len(scales) * self.n_pairs)
        return np.column_stack(
            [np.tile(poses, (len(scales), 1)), np.repeat(scales, len(poses))],
        )

    def score(self, seeds: np.ndarray) -> tuple[np.ndarray, int]:
        """Score by nearest neighbours, without an assignment.

        The sum is divided by the scale, because a smaller source is near the target by chance.
        """
        scores = np.empty(len(seeds))
        for scale in np.unique(seeds[:, SCALE]):
            at = np.flatnonzero(seeds[:, SCALE] == scale)
            some = np.empty(len(at))
            poses = np.ascontiguousarray(seeds[at, :SCALE])
            nearest_scores(poses, self._scaled(scale), some)
            scores[at] = some / scale
        return scores, 0

    def pose(self, theta: np.ndarray) -> np.ndarray:
        """Return the (4, 4) pose."""
        T: np.ndarray = np.eye(4)
        T[:3, :3] = theta[SCALE] * rotation_matrix(np.asarray(theta[:4], dtype=np.float64))
        T[:3, 3] = theta[4:SCALE]
        return T

    def parameter(self, T: np.ndarray) -> np.ndarray:
        """Return the parameter of a (4, 4) pose, with the scale clipped to the range."""
        return self.normalised(self._parameter(T))
