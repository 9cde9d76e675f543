"""Go-ICP: nested branch and bound over rotations and translations, with ICP for the incumbent.

The search minimises the sum of the k smallest squared distances from moved source points to their nearest
target points (many to one). The outer search divides the cube [-pi, pi]^3 of rotation vectors. Rotations
of a cube with half-width s lie within an angle alpha = min(sqrt(3) s, pi) of its centre, so point i lies
within gamma_i = 2 sin(alpha / 2) |x_i| of its position by the centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from baselines._shared.closest_point import ClosestPoint, spread_poses
from baselines._shared.cubes import Incumbent, OutOfTimeError, search_cubes
from baselines._shared.poses import homogeneous
from baselines.goicp import kernels
from baselines.goicp.distance import Cells
from dcreg.search import Budget, Outcome

_DISTANCES_PER_SLICE = 200_000  # of the inner search between two checks of the budget, about 20 ms
# The inner search stops when it knows the relaxed minimum to this share of the tolerance. With the whole
# tolerance, as published, a true bound (unlike the relaxed minimum itself) prunes too few cubes.
_INNER_SHARE = 0.5


@dataclass(frozen=True)
class Settings:
    """Options of the card; lengths in the units of the points given to `search`."""

    n_kept: int
    tolerance: float
    translation_centre: np.ndarray
    translation_half_width: float
    cells_per_axis: int
    icp_tolerance: float
    n_starts: int
    seed: int


class GoICP:
    """One problem: arrays, the distance cells, and the bounds of a rotation cube."""

    def __init__(
        self, source: np.ndarray, target: np.ndarray, settings: Settings, budget: Budget
    ) -> None:
        self.source, self.settings, self.budget = source, settings, budget
        self.norms = np.linalg.norm(source, axis=1)
        self.local = ClosestPoint(source, target, settings.n_kept)
        reach = (
            self.norms.max()
            + np.abs(settings.translation_centre).max()
            + settings.translation_half_width
        )
        self.cells = Cells(target, max(reach, 1e-12), settings.cells_per_axis)
        self.incumbent = Incumbent()
        self.n_translation_cubes = 0
        self._heap = np.empty((4096, 5))

    def run(self) -> Outcome:
        """Search all rotations until the gap is closed or a limit is reached."""
        settings = self.settings
        centre, half = settings.translation_centre, settings.translation_half_width
        nearest_zero = np.clip(np.zeros(3), centre - half, centre + half)
        self._descend(spread_poses(settings.n_starts, settings.seed, nearest_zero))
        root = np.zeros(3), np.pi
        return search_cubes(
            self.bound_cube, root, self.incumbent, self.budget, gap_tol=settings.tolerance
        )

    def bound_cube(
        self, centre: np.ndarray, half: float, passed_on: None = None
    ) -> tuple[float, None]:
        """Bound the rotations of a cube with all translations from below; improve the incumbent."""
        if np.linalg.norm(centre) - np.sqrt(3.0) * half > np.pi:
            return (
                np.inf,
                None,
            )  # outside the ball of rotation vectors: other cubes contain its rotations
        rotation = Rotation.from_rotvec(centre).as_matrix()
        for gamma in (np.zeros(len(self.source)), uncertainty(half, self.norms)):
            bound, value, translation = self.search_translations(rotation, gamma)
            if value < self.incumbent.value:
                self._descend(homogeneous(1.0, rotation, translation)[None])
        return bound, None

    def search_translations(
        self, rotation: np.ndarray, gamma: np.ndarray
    ) -> tuple[float, float, np.ndarray]:
        """Return the relaxed lower bound, and the minimum true value found with its translation."""
        settings = self.settings
        points = self.source @ rotation.T
        cutoff = self.incumbent.value - settings.tolerance
        state = np.zeros(8)
        state[[kernels.DISCARDED, kernels.RELAXED, kernels.TRUE]] = np.inf
        state[kernels.SIZE] = 1
        self._heap[0] = 0.0, *settings.translation_centre, settings.translation_half_width
        per_slice = max(8, _DISTANCES_PER_SLICE // len(points))
        code = kernels.PAUSED
        while code != kernels.FINISHED:
            code = kernels.search_translations(
                points, gamma, settings.n_kept, self.cells.arrays, cutoff,
                _INNER_SHARE * settings.tolerance, self._heap, state, per_slice,
            )  # fmt: skip
            if code == kernels.FULL:
                self._heap = np.concatenate([self._heap, np.empty_like(self._heap)])
            elif code == kernels.PAUSED and self.budget.is_over:
                raise OutOfTimeError
        self.n_translation_cubes += int(state[kernels.EVALUATED])
        open_bound = self._heap[0, 0] if state[kernels.SIZE] > 0 else np.inf
        translation = state[kernels.TRUE_X : kernels.TRUE_Z + 1].copy()
        return min(open_bound, state[kernels.DISCARDED]), state[kernels.TRUE], translation

    def _descend(self, poses: np.ndarray) -> None:
        refined, _ = self.local.descend_until(poses, self.settings.icp_tolerance, self.budget)
        # A descent may leave the cube of translations to which the bounds refer.
        for pose in (*refined, *poses):
            offset = np.abs(pose[:3, 3] - self.settings.translation_centre).max()
            if offset <= self.settings.translation_half_width:
                self.incumbent.offer(self.local.value(pose), pose)


def uncertainty(half: float, norms: np.ndarray) -> np.ndarray:
    """Return how far rotations of a cube with this half-width move points relative to its centre."""
    return 2.0 * np.sin(min(np.sqrt(3.0) * half, np.pi) / 2.0) * norms
