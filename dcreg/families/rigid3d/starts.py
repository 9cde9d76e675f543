"""Initial poses of a rigid search if many points have no partner: poses of congruent triples.

A rigid motion preserves distances. Three source points and three target points with the same distances
determine a pose. Among enough random source triples one consists of points with a partner, and one of
all its congruent target triples is the right one. The score of a pose is the number of source points
near the target. The best distinct poses are returned. The idea is that of congruent sets (Aiger,
Mitra and Cohen-Or 2008); the details are this project's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from dcreg.assignment.alternation import follow_nearest
from dcreg.families.rigid3d.kernels import congruent as kernels
from dcreg.families.starts import distinct, nearness_field
from dcreg.jit import NEVER
from dcreg.problem import rms_radius
from dcreg.problem.trees import tree_of

MAX_TARGETS = 300  # target points that form triples
NEARLY_ALL = 400  # target points of which these have nearly all partners
MAX_LOOKED = 150  # source points used for the score
# Accepted probability that no triple consists of true pairs; congruent clutter hides some.
FAILURE = 1e-9
ENOUGH = 1e-3  # ... before rounds that agree end the starts
LIKELY = 3e-2  # ... if at least half of them agree, of large clouds
N_TRIPLES = 60  # a round
MAX_ROUNDS = 80
MAX_SAMPLE = 300  # source points that follow their nearest neighbours
SHORTEST = 0.6  # side of a source triple, in RMS radii; short sides determine a rotation badly
KEPT_PER_TRIPLE = 6
MAX_POSES = 30  # returned by a round
MAX_CELLS = 256  # of the nearness field along the longest side: about 150 MB
MIN_CONFIRMED = 12  # pairs; fewer agree by chance
AGREEING = 2  # rounds that must find the best pose
ALIKE = 1.1  # ratio of objectives up to which two ends near each other count as one pose
CLEARLY_WORSE = 1.25  # ratio of objectives from which another pose is no alternative
APART = 0.5  # displacement of the same vertices from which two poses are alternatives
N_THREADS = 2  # that work on rounds of large clouds; the poses do not depend on it
SEPARATION = 0.15  # poses that move the vertices of a unit tetrahedron by less count as one


@dataclass(frozen=True)
class Scale:
    """Tolerances of congruence and nearness, in RMS radii of the target.

    Attributes
    ----------
    tolerance : float
        Difference of two distances that count as equal.
    reach : float
        Distance beyond which a point is not near the target.
    """

    tolerance: float
    reach: float


# The noise is unknown: a fine scale distinguishes more poses, a coarse one tolerates more noise.
SCALES = (Scale(0.04, 0.06), Scale(0.06, 0.1), Scale(0.09, 0.2))


class TripleSearch(NamedTuple):
    """What a search for target triples like random source triples needs; see `triple_poses`.

    Attributes
    ----------
    clouds : (source, target)
        All source points, and those target points that form triples.
    triples : (T, 3) int array
        Of the source. Those with short sides are left out: nearly every target triple is like them.
    sides : (T, 3) array
        See `side_lengths`.
    lengths : (L,) array
        Of all ordered pairs of target points, ascending.
    feasible, pairs
        As in `triple_poses`.
    search : (tolerance, looked, field)
        As in `triple_poses`, without the stop flag.
    """

    clouds: tuple[np.ndarray, np.ndarray]
    triples: np.ndarray
    sides: np.ndarray
    lengths: np.ndarray
    feasible: np.ndarray
    pairs: tuple[np.ndarray, ...]
    search: tuple[Any, ...]

    @classmethod
    def of(
        cls,
        x: np.ndarray,
        y: np.ndarray,
        noise: Scale,
        candidates: np.ndarray | None,
        seed: int,
        n_triples: int,
        max_targets: int,
    ) -> TripleSearch:
        """Draw the triples and the points."""
        rng = np.random.default_rng(seed)
        triples = long_triples(x, rng)[:n_triples]
        columns = np.sort(rng.permutation(len(y))[:max_targets])
        feasible = np.empty((0, 0), np.bool_)
        if candidates is not None:
            feasible = np.ascontiguousarray(candidates[:, columns])
        looked = x[rng.permutation(len(x))[:MAX_LOOKED]]
        some, field = y[columns], nearness_field(y, noise.reach, MAX_CELLS)
        first, second, lengths, distances = pairs_by_length(some)
        order = np.argsort(distances, axis=1, kind="stable")
        ascending = np.take_along_axis(distances, order, axis=1)
        sides = side_lengths(x, triples)
        telling = sides.min(axis=1) > 2.0 * noise.tolerance
        return cls(
            (x, some), triples[telling], sides[telling], lengths, feasible,
            (first, second, distances, order, ascending), (noise.tolerance, looked, field),
        )  # fmt: skip

    def best(
        self, kernel: Callable[..., int], sides: Sequence[np.ndarray], stop: np.ndarray
    ) -> np.ndarray:
        """Return the best distinct poses that a kernel like `triple_poses` finds, as (P, 4, 4)."""
        poses = np.zeros((len(self.triples), KEPT_PER_TRIPLE, 3, 4))
        scores = np.zeros((len(self.triples), KEPT_PER_TRIPLE))
        kernel(
            self.triples, np.column_stack(sides), self.clouds, self.feasible, self.pairs,
            (*self.search, stop), poses, scores,
        )  # fmt: skip
        return distinct_poses(poses.reshape(-1, 3, 4), scores.ravel(), MAX_POSES)


def congruent_poses(
    source: np.ndarray,
    target: np.ndarray,
    scale: Scale,
    candidates: np.ndarray | None = None,
    *,
    seed: int = 0,
    stop: np.ndarray = NEVER,
) -> np.ndarray:
    """Return the best distinct poses of congruent triples, best first.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    scale : Scale
    candidates : (n, m) bool array, optional
        The feasible pairs.
    seed : int
    stop : (1,) uint8 array
        When it is set, the poses found so far are returned.

    Returns
    -------
    (P, 4, 4) array
        Proper rigid poses; none if no triples are congruent.
    """
    unit = rms_radius(target)
    if len(source) < 3 or len(target) < 3 or unit == 0.0:
        return np.empty((0, 4, 4))
    x, y = np.ascontiguousarray(source / unit), np.ascontiguousarray(target / unit)
    search = TripleSearch.of(x, y, scale, candidates, seed, N_TRIPLES, MAX_TARGETS)
    ends = [
        np.searchsorted(search.lengths, search.sides[:, 0] + by)
        for by in (-scale.tolerance, scale.tolerance)
    ]
    found = search.best(kernels.triple_poses, [search.sides[:, 1:], *ends], stop)
    found[:, :3, 3] *= unit
    return found


def rounds_for(
    n_source: int,
    n_target: int,
    n_inliers: int,
    failure: float,
    *,
    n_triples: int = N_TRIPLES,
    max_targets: int = NEARLY_ALL,
) -> int:
    """Return the number of rounds after which one had a triple of true pairs, but for this probability.

    All partners of a triple must be among the target points that form triples. At least `AGREEING`, so
    that rounds can agree, and at most `MAX_ROUNDS`.
    """
    share = (n_inliers / n_source * min(1.0, max_targets / n_target)) ** 3
    needed = np.log(failure) / np.log1p(-share) / n_triples if share < 1.0 else 0.0
    return int(np.clip(np.ceil(needed), AGREEING, MAX_ROUNDS))


def is_confirmed(
    rounds: Sequence[Sequence[tuple[np.ndarray, float]]], least: int = AGREEING
) -> bool:
    """Tell whether independent rounds agree on the best pose, and no other pose is an alternative.

    Near the best pose there are often others that are almost as good, because the clouds slide along each
    other. They count as one alternative; the fit of all points chooses among them.

    Parameters
    ----------
    rounds : sequence of sequences of ((12,) array, float)
        For each round, where its local searches ended: the coordinates of the moved vertices of a unit
        tetrahedron, and the objective.
    least : int
        Rounds that must find the best pose.
    """
    ends = [end for each in rounds for end in each]
    if len(rounds) < least or not ends:
        return False
    best, value = min(ends, key=itemgetter(1))

    def displacement(vertices: np.ndarray) -> float:
        return float(np.abs(vertices - best).max())

    agreeing = sum(
        any(
            displacement(vertices) <= SEPARATION and other <= ALIKE * value
            for vertices, other in each
        )
        for each in rounds
    )
    others = (other for vertices, other in ends if displacement(vertices) > APART)
    runner_up = min(others, default=np.inf)
    return agreeing >= least and runner_up >= CLEARLY_WORSE * value


def best_descents(
    poses: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    count: int = 3,
    *,
    seed: int = 0,
    fit_pairs: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Refine poses by nearest neighbours of a sample of the source, and return the best distinct ones.

    For clouds so large that a one-to-one matching takes long. Alternates the nearest neighbours of the
    trimmed sample and their pose by `fit_pairs`.

    Returns
    -------
    (P, 4, 4) array
        At most `count`, best first.
    """
    rng = np.random.default_rng(seed)
    sample = source[np.sort(rng.permutation(len(source))[:MAX_SAMPLE])]
    k = max(3, round(n_inliers * len(sample) / len(source)))
    if not len(poses):
        return poses
    found, values = follow_nearest(sample, tree_of(target), poses, k, fit_pairs)
    return distinct_poses(found[:, :3], 1.0 / np.maximum(values, np.finfo(float).tiny), count)


def long_triples(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw random triples with long sides."""
    drawn = rng.integers(len(points), size=(20 * N_TRIPLES, 3))
    shortest = side_lengths(points, drawn).min(axis=1)
    long = np.flatnonzero(shortest >= SHORTEST)
    if len(long) < N_TRIPLES:  # a small or flat cloud: take the longest sides
        long = np.argsort(-shortest, kind="stable")
    return drawn[long[:N_TRIPLES]]


def side_lengths(points: np.ndarray, triples: np.ndarray) -> np.ndarray:
    """Return (T, 3) distances: first to second point, first to third, second to third."""
    vertices = points[triples]
    ends = ((0, 1), (0, 2), (1, 2))
    return np.stack(
        [np.linalg.norm(vertices[:, a] - vertices[:, b], axis=1) for a, b in ends], axis=1
    )


def pairs_by_length(points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return first and second points of all ordered pairs by length, the lengths, and all distances."""
    distances = np.sqrt(sum(np.subtract.outer(axis, axis) ** 2 for axis in points.T))
    first, second = np.nonzero(~np.eye(len(points), dtype=bool))
    lengths = distances[first, second]
    order = np.argsort(lengths, kind="stable")
    return first[order], second[order], lengths[order], distances


def distinct_poses(poses: np.ndarray, scores: np.ndarray, count: int) -> np.ndarray:
    """Return the best poses that differ, as (P, 4, 4)."""
    tetrahedron = np.vstack([np.zeros(3), np.eye(3)])
    moved = np.einsum("pab,cb->pca", poses[:, :, :3], tetrahedron) + poses[:, None, :, 3]
    kept = distinct(moved.reshape(-1, 12), scores, SEPARATION, count)
    out = np.tile(np.eye(4), (len(kept), 1, 1))
    out[:, :3] = poses[kept]
    return out
