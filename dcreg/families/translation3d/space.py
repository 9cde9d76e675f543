"""3D translation in norm space: theta = t, and |x + t| is matched with |y| (DC-Reg, Case II)."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from dcreg.assignment.kernels.line import line_value
from dcreg.assignment.kernels.sorting import COLUMNS
from dcreg.families.dc.kernels import objectives
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.means import mean_of_largest, means_of_subsets
from dcreg.families.translation3d.kernels.fit import fit_norm3d
from dcreg.families.translation3d.kernels.line import match_on_line, objectives_on_line
from dcreg.names import NORM_TRANSLATION
from dcreg.search import Box

# Points, `COLUMNS` times: that takes hundredths of a second. More points are matched for one translation.
_AT_ONCE = 20_000
_STEPS = 20  # of the fit to one matching


class Translation3D(FeatureSpace):
    """Match the norms of the moved source and of the target, which do not depend on the rotation.

    The objective is ``sum p_ij (|x_i + t| - |y_j|)^2``. It is a lower bound on the rigid objective for
    every rotation. It is only a surrogate: its optimum need not be the optimal rigid pose.

    The origin of the target is the centre of rotation. With `candidates` the assignment is not
    one-dimensional and takes longer.
    """

    scope = NORM_TRANSLATION
    identity = np.zeros(3)

    axis_weights = np.ones(3)

    @staticmethod
    def target_features(target: np.ndarray) -> np.ndarray:
        """Return the (m,) norms of the target."""
        return np.sqrt((target**2).sum(axis=1))

    @property
    def norms(self) -> np.ndarray:
        return self.clouds.target

    @cached_property
    def _ordered(self) -> np.ndarray:
        return np.sort(self.norms)

    @property
    def _on_line(self) -> bool:
        """Whether every pair is feasible: scalars are then matched without a matrix of costs."""
        return self.candidates is None

    def roots(self) -> list[Box]:
        """Return the start box.

        Every minimiser is stationary: t = mean of (|y| u - x) over the matched pairs, u unit vectors.
        """
        if not self.stationary_box:
            reach = self.norms.max() + np.sqrt((self.source**2).sum(axis=1)).max()
            return [Box(np.full(3, -reach), np.full(3, reach))]
        reach = mean_of_largest(self.norms, self.n_inliers)
        low_x, high_x = means_of_subsets(self.source.T, self.n_inliers)
        return [Box(-(reach + high_x), reach - low_x)]

    def seeds(self) -> np.ndarray:
        """Return the identity and its 26 neighbours on a coarse grid."""
        steps = 0.5 * np.array([0.0, -1.0, 1.0])
        return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)

    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        if not self._on_line:
            return super().objective(theta)
        self.check()
        return match_on_line(self._moved_norms(theta), self.norms, self.n_inliers)

    def _moved_norms(self, theta: np.ndarray) -> np.ndarray:
        x, y, z = (axis + shift for axis, shift in zip(self.clouds.source, theta, strict=True))
        return np.asarray(np.sqrt(x * x + y * y + z * z))

    def objectives(self, thetas: np.ndarray, values: np.ndarray) -> int:
        if not self._on_line:
            return objectives(self.clouds, thetas, values)
        source, ordered, k = self.clouds.source, self._ordered, self.n_inliers
        size = COLUMNS * (_AT_ONCE // self.n_source) or 1
        for at in range(0, len(thetas), size):
            if self.stop_flag[0]:  # which the kernels ignore
                break
            part = slice(at, at + size)
            if size > 1:
                objectives_on_line(source, ordered, k, thetas[part], values[part])
            else:
                values[at] = line_value(np.sort(self._moved_norms(thetas[at])), ordered, k)
        return len(thetas)

    def score(self, seeds: np.ndarray) -> tuple[np.ndarray, int]:
        """Score by the objective."""
        values = np.empty(len(seeds))
        return values, self.objectives(seeds, values)

    def fit_matching(self, theta: np.ndarray, col_of: np.ndarray) -> np.ndarray:
        """Return `theta` after a few steps towards the best translation for the norms of the pairs."""
        rows = np.flatnonzero(col_of >= 0)
        trial = theta.copy()
        axes = np.ascontiguousarray(self.clouds.source[:, rows])
        fit_norm3d(axes, self.norms[col_of[rows]], _STEPS, trial)
        return trial

    def pose(self, theta: np.ndarray) -> np.ndarray:
        """Return the pose of the translation; the rotation about the origin follows."""
        T = np.eye(4)
        T[:3, 3] = theta
        return T
