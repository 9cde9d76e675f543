"""Rigid poses in 3D: the space of mode `full`.

For points x_i, y_j and k pairs the problem is

    min over R in SO(3), t in R^3 and one-to-one P of k pairs of  sum_ij p_ij |R x_i + t - y_j|^2.

The norm space of the paper only bounds this objective from below. theta is a quaternion of any length
followed by t; the quaternions are those of the four facets of `dcreg.families.rotation3d.space`.

Start box
---------
For fixed pairs the best t is mean(y) - R mean(x). An optimum therefore has a translation within the
range of the means of any k targets, extended by the maximum length of the mean of any k sources. If all
points of both clouds match and both clouds are centred, this is the single value 0, and only the
rotation is searched.
"""

from __future__ import annotations

import abc
import itertools
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Self

import numpy as np

from dcreg.assignment.alternation import alternate_assignments
from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.means import mean_of_largest, means_of_subsets
from dcreg.families.parallel import in_threads
from dcreg.families.protocol import radius
from dcreg.families.rigid3d.kernels.poses import nearest_scores, pose_costs
from dcreg.families.rigid3d.starts import (
    AGREEING,
    ENOUGH,
    FAILURE,
    LIKELY,
    MIN_CONFIRMED,
    N_THREADS,
    SCALES,
    SEPARATION,
    best_descents,
    congruent_poses,
    is_confirmed,
    rounds_for,
)
from dcreg.families.rotation3d.kernels.geometry import best_rotation, rotation_matrix
from dcreg.families.rotation3d.space import CloudSpace, Rotation3D
from dcreg.families.starts import distinct
from dcreg.names import RIGID_POSE
from dcreg.problem import PairWeights
from dcreg.problem.geometry import apply_pose, fit_pose, representative_points, sampled_pairs
from dcreg.search import Box, Budget

_SCORED_PAIRS = 100_000_000  # pairs evaluated to score the seeds
_ROUNDING = 1e-12
_CONGRUENT_SHARE = 0.5  # maximum share of the time for the poses of congruent triples
DENSE_DESCENTS = 40_000  # point pairs beyond which local searches begin with nearest neighbours
NEARLY = 2.0  # ratio of objectives up to which a local search from a box of such clouds pays
COARSE_PAIRS = 200_000  # beyond which the first local searches are on few points
COARSE_POINTS, MAX_COARSE = 300, 1200  # of the smaller and of the larger cloud
FEW_DESCENTS = 6  # local searches from the grid before agreement can end them
MAX_FINE = 5  # poses of the few points that are refined on all
MAX_CONFIRMED = 2  # ... if they are confirmed: the best one and a runner-up


def coarse_sizes(n: int, m: int) -> tuple[int, int]:
    """Return the points of clouds of n <= m points from which a search starts, as dense as each other."""
    few = min(n, COARSE_POINTS)
    return few, min(m, MAX_COARSE, round(few * m / n))


def largest_subset_mean_3d(
    points: np.ndarray, count: int, lightest: float = 1.0, cells: int = 8
) -> float:
    """Return an upper bound on ``|mean of any `count` points|`` of (n, 3) points.

    Means have weights from `lightest` to 1.

    The support function of the subset means is the mean of the largest projections. Directions are
    sampled at the cell centres of the faces of a cube: another point of a cell is at most sqrt(2) /
    cells away and both have length >= 1, so they differ by an angle of at most 2 asin(distance / 2).
    """
    steps = (2.0 * np.arange(cells) + 1.0) / cells - 1.0
    face = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    half = np.concatenate([np.insert(face, axis, 1.0, axis=1) for axis in range(3)])
    directions = half / np.linalg.norm(half, axis=1, keepdims=True)
    projections = points @ np.concatenate([directions, -directions]).T
    farthest = max(0.0, float(mean_of_largest(projections, count, lightest).max()))
    return farthest / np.cos(2.0 * np.arcsin(np.sqrt(0.5) / cells))


class Poses3D(CloudSpace):
    """Poses of centred clouds in 3D; theta begins with a quaternion and a translation.

    Centred clouds have the smallest start box.
    """

    n_descents = 24
    max_scale = 1.0
    scale_range = 1.0, 1.0

    def translations(self) -> Box:
        """Return a box that contains the translation of every optimum."""
        k, source, target = self.n_inliers, self.clouds.source, self.clouds.target
        if self.stationary_box:
            if k == source.shape[1] and self.lightest == 1.0:
                reach = float(np.linalg.norm(source.mean(axis=1)))
            else:
                reach = largest_subset_mean_3d(source.T, k, self.lightest)
            reach *= self.max_scale
            lower, upper = means_of_subsets(target, k, self.lightest)
            # rounding must not cut off the optimum, but the box of a centred cloud keeps zero width
            reach = 0.0 if reach < _ROUNDING else reach
            lower, upper = (np.where(np.abs(v) < _ROUNDING, 0.0, v) for v in (lower, upper))
            return Box(lower - reach, upper + reach)
        reach = self.max_scale * radius(source.T) + radius(target.T)
        return Box(np.full(3, -reach), np.full(3, reach))

    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        value, col_of, _ = cheapest_pairs(self._costs(theta), self.n_inliers, self.stop_flag)
        self.check()
        return float(value), col_of

    def fit_matching(self, theta: np.ndarray, col_of: np.ndarray) -> np.ndarray:
        rows = np.flatnonzero(col_of >= 0)
        weights, (source, target) = self.weights_of(rows, col_of[rows]), self.matched(col_of)
        if weights is None:
            return self.fit(source, target)
        return self._parameter(fit_pose(source.T, target.T, self.scale_range, weights))

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Alternate matching and fit; each assignment starts from the previous dual variables."""
        theta, value, spent = alternate_assignments(
            theta, self._costs, self.n_inliers, self.fit_matching, self.min_gain, self.stop_flag,
            is_admissible=bool(self.admissible(theta[None])[0]),
        )  # fmt: skip
        return self.normalised(theta), value, spent

    def worth_refining(self, value: float) -> float:
        """A local search from a poor pose of large clouds takes long; a confirmed pose is better."""
        return NEARLY * value if self.is_confirmed and self.n_pairs > DENSE_DESCENTS else np.inf

    def normalised(self, theta: np.ndarray) -> np.ndarray:
        theta = theta.copy()
        theta[:4] /= theta[:4][np.argmax(np.abs(theta[:4]))]
        return theta

    def starts(self, budget: Budget) -> Iterator[tuple[np.ndarray, int]]:
        """Yield initial poses until they are confirmed: of congruent triples, then of a regular grid.

        Large clouds use a sample of their points first. If all points match, there is only the grid: the
        centroids then match too, and only rotations remain.
        """
        box = self.translations()
        if (box.lower == box.upper).all():
            yield from self._grid_starts(budget)
        elif self._starts_from_sample and self.candidates is None:
            yield from self._coarse_starts(budget)
        else:
            yield from self._congruent_starts(budget.sub_budget(_CONGRUENT_SHARE))
            if not self.is_confirmed:
                yield from super().starts(budget)

    def _grid_starts(self, budget: Budget) -> Iterator[tuple[np.ndarray, int]]:
        """Yield poses of a regular grid; for large clouds, end when local searches agree."""
        for tried, start in enumerate(super().starts(budget)):
            if (
                tried >= FEW_DESCENTS
                and self.n_pairs > DENSE_DESCENTS
                and self._local_searches_agree()
            ):
                break
            yield start
        self.is_confirmed = self.n_inliers >= MIN_CONFIRMED and self._local_searches_agree()

    def _local_searches_agree(self) -> bool:
        """Tell whether two local searches found the best pose, and no other pose is nearly as good."""
        return is_confirmed([[(self._vertices(theta), value)] for theta, value in self.ends])

    def _congruent_starts(self, budget: Budget) -> Iterator[tuple[np.ndarray, int]]:
        """Yield poses of rounds of congruent triples until they are confirmed."""
        is_dense = self.n_pairs > DENSE_DESCENTS
        few, enough, most = map(self._rounds, (LIKELY if is_dense else ENOUGH, ENOUGH, FAILURE))
        threads = N_THREADS if is_dense else 1
        work = partial(self._congruent, budget=budget)
        # more rounds than the first few are made two at a time
        seeds = np.split(np.arange(len(SCALES) * most), np.arange(few, len(SCALES) * most, 2))
        rounds: list[Sequence[tuple[np.ndarray, float]]] = []
        for thetas in itertools.chain.from_iterable(
            in_threads(work, some.tolist(), threads) for some in seeds
        ):
            known = len(self.ends)
            for theta in thetas:
                yield theta, 0
            rounds.append([(self._vertices(theta), v) for theta, v in self.ends[known:]])
            if len(rounds) >= few and self.n_inliers >= MIN_CONFIRMED:
                least = AGREEING if len(rounds) >= enough else max(AGREEING, -(-len(rounds) // 2))
                self.is_confirmed = is_confirmed(rounds, least)
                if self.is_confirmed:
                    return

    def _regular_poses(self, n_pairs: int) -> np.ndarray:
        """Return regular poses, as many as can be scored quickly; always with t at the box centre.

        Parameters
        ----------
        n_pairs : int
            Pairs of points evaluated for each pose.
        """
        box = self.translations()
        per_axis = 3 if 27 * 256 * n_pairs <= _SCORED_PAIRS else 1
        cells = 4 if per_axis**3 * 256 * n_pairs <= _SCORED_PAIRS else 2
        rotations = Rotation3D.grid(cells)
        offsets = (np.arange(per_axis) - per_axis // 2) / max(1, per_axis)
        shifts = np.array(list(itertools.product(offsets, repeat=3))) * (box.upper - box.lower)
        shifts = np.unique(shifts, axis=0) + box.centre
        return np.concatenate(
            [np.repeat(rotations, len(shifts), axis=0), np.tile(shifts, (len(rotations), 1))],
            axis=1,
        )

    def _rounds(self, failure: float) -> int:
        """Return the number of rounds after which one had a triple of true pairs, but for `failure`."""
        return rounds_for(self.n_source, self.n_target, self.n_inliers, failure)

    @property
    def _starts_from_sample(self) -> bool:
        """Whether initial poses come from fewer points."""
        sizes = self.n_source, self.n_target
        return self.n_pairs > COARSE_PAIRS and coarse_sizes(*sizes) != sizes

    def _coarse_starts(self, budget: Budget) -> Iterator[tuple[np.ndarray, int]]:
        """Yield the best distinct poses of the local searches on a sample of both clouds."""
        clouds = [points.T for points in (self.clouds.source, self.clouds.target)]
        counts = coarse_sizes(self.n_source, self.n_target)
        some = [
            points[representative_points(points, count)]
            for points, count in zip(clouds, counts, strict=True)
        ]
        k = sampled_pairs(self.n_inliers, clouds, some)
        coarse = self.of_points(some[0], some[1], k)
        _, _, spent = coarse.start(budget.silent())
        self.is_confirmed = coarse.is_confirmed
        if not coarse.ends:
            return
        values = np.array([value for _, value in coarse.ends])
        vertices = np.array([self._vertices(theta) for theta, _ in coarse.ends])
        count = MAX_CONFIRMED if self.is_confirmed else MAX_FINE
        tiny = np.finfo(float).tiny  # few pairs of a sample can fit exactly
        scores = (values.min() + tiny) / (values + tiny)
        for at in distinct(vertices, scores, SEPARATION, count):
            yield coarse.ends[at][0], spent
            spent = 0

    def _congruent(self, seed: int, budget: Budget) -> list[np.ndarray]:
        """Return the parameters of poses of a round of congruent triples; scales take turns."""
        if budget.is_over:
            return []
        source, target = self.clouds.source.T, self.clouds.target.T
        poses = self._poses_of_triples(seed)
        if self.n_pairs > DENSE_DESCENTS:
            poses = best_descents(
                poses, source, target, self.n_inliers, seed=seed, fit_pairs=self.fit_pairs
            )
        return [self._parameter(T) for T in poses]

    @abc.abstractmethod
    def _costs(self, theta: np.ndarray) -> np.ndarray:
        """Return the (n, m) squared residuals at a pose, with the penalties of infeasible pairs."""

    @abc.abstractmethod
    def of_points(self, source: np.ndarray, target: np.ndarray, n_inliers: int) -> Poses3D:
        """Return the same space over other points, without candidates."""

    @abc.abstractmethod
    def fit_pairs(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the (P, 4, 4) least-squares poses of paired (P, k, 3) points."""

    @abc.abstractmethod
    def _poses_of_triples(self, seed: int) -> np.ndarray:
        """Return the (P, 4, 4) poses of a round of triples."""

    def _parameter(self, T: np.ndarray) -> np.ndarray:
        """Return the parameter of a (4, 4) pose, by the fit to four moved points."""
        tetrahedron = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        return self.fit(tetrahedron.T, apply_pose(T, tetrahedron).T)

    @staticmethod
    @abc.abstractmethod
    def _vertices(theta: np.ndarray) -> np.ndarray:
        """Return the (12,) coordinates of the moved vertices of a unit tetrahedron."""


class Rigid3D(Poses3D):
    """Rigid poses of centred clouds; theta is a quaternion and a translation, y = R x + t.

    n <= m is faster; see `between`.
    """

    # A unit step of a facet coordinate rotates by 1 to 2 radians, which moves points at the RMS radius
    # by about this much. A unit step of the translation moves them by one.
    axis_weights = np.array([1.3, 1.3, 1.3, 1.3, 1.0, 1.0, 1.0])
    scope = RIGID_POSE

    _swapped = False

    @classmethod
    def between(
        cls,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        candidates: np.ndarray | None = None,
        *settings: Any,
    ) -> Rigid3D:
        """Return the space in which the smaller cloud moves; `pose` still returns poses of `source`.

        Nearest distances are taken from the moving cloud, so the smaller one is the better choice. The
        inverse pose has the same residuals.
        """
        swapped = len(source) > len(target)
        if swapped:
            source, target = target, source
            if candidates is not None:  # in C order, because kernels are compiled for C order only
                candidates = np.ascontiguousarray(candidates.T)
        space = cls(source, target, n_inliers, candidates, *settings)
        space._swapped = swapped
        return space

    def roots(self) -> list[Box]:
        """Return boxes that together contain every optimum."""
        box = self.translations()
        return [
            Box(np.append(facet.lower, box.lower), np.append(facet.upper, box.upper))
            for facet in Rotation3D.roots()
        ]

    def _costs(self, theta: np.ndarray) -> np.ndarray:
        cost = np.empty((self.n_source, self.n_target))
        pose_costs(theta, self.clouds, cost)
        return cost

    def fit(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the quaternion and the translation (Horn 1987, centred)."""
        x, y = source.mean(axis=1), target.mean(axis=1)
        rotation = best_rotation(source - x[:, None], target - y[:, None])
        return np.append(rotation, y - rotation_matrix(rotation) @ x)

    def weighted(self, weights: PairWeights) -> Self:
        if self._swapped:
            weights = PairWeights(weights.factors.T, weights.extra.T)
        return super().weighted(weights)

    def of_points(self, source: np.ndarray, target: np.ndarray, n_inliers: int) -> Rigid3D:
        """Return the same space over other points, without candidates."""
        return Rigid3D(source, target, n_inliers, None, self.stop_flag, self.stationary_box)

    def _poses_of_triples(self, seed: int) -> np.ndarray:
        source, target = self.clouds.source.T, self.clouds.target.T
        return congruent_poses(
            source, target, SCALES[seed % len(SCALES)], self.candidates, seed=seed,
            stop=self.stop_flag,
        )  # fmt: skip

    def fit_pairs(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return fit_pose(source, target, (1.0, 1.0))

    @staticmethod
    def _vertices(theta: np.ndarray) -> np.ndarray:
        """Return the (12,) coordinates of the moved vertices of a unit tetrahedron."""
        R, t = rotation_matrix(np.asarray(theta[:4], dtype=np.float64)), theta[4:]
        return np.concatenate([t, *(R.T + t)])

    def seeds(self) -> np.ndarray:
        return self._regular_poses(self.n_pairs)

    def score(self, seeds: np.ndarray) -> tuple[np.ndarray, int]:
        """Score by nearest neighbours, without an assignment."""
        scores = np.empty(len(seeds))
        nearest_scores(seeds, self.clouds, scores)
        return scores, 0

    def pose(self, theta: np.ndarray) -> np.ndarray:
        """Return the (4, 4) pose of the source; see `between`."""
        T: np.ndarray = np.eye(4)
        T[:3, :3] = rotation_matrix(np.asarray(theta[:4], dtype=np.float64))
        T[:3, 3] = theta[4:]
        return np.linalg.inv(T) if self._swapped else T

    def parameter(self, T: np.ndarray) -> np.ndarray:
        """Return the parameter of a (4, 4) pose of the source: the inverse of `pose`."""
        return self.normalised(self._parameter(np.linalg.inv(T) if self._swapped else T))
