"""Initial poses of a similarity search in 3D: poses of similar triples.

They are those of `dcreg.families.rigid3d.starts`, except that the scale is free: the ratios of the sides
of two triples agree, and their scale lies in the range. There are more such triples, so fewer target
points form them.
"""

from __future__ import annotations

import numpy as np

from dcreg.families.rigid3d.starts import (
    AGREEING,
    KEPT_PER_TRIPLE,
    MAX_CELLS,
    MAX_LOOKED,
    MAX_POSES,
    MAX_ROUNDS,
    Scale,
    distinct_poses,
    long_triples,
    pairs_by_length,
    side_lengths,
)
from dcreg.families.similarity3d.kernels.triples import similar_triple_poses
from dcreg.families.starts import nearness_field
from dcreg.jit import NEVER
from dcreg.problem import rms_radius

MAX_TARGETS = 120  # target points that form triples
N_TRIPLES = 30  # a round


def similar_poses_3d(
    source: np.ndarray,
    target: np.ndarray,
    scale_range: tuple[float, float],
    noise: Scale,
    candidates: np.ndarray | None = None,
    *,
    seed: int = 0,
    stop: np.ndarray = NEVER,
) -> np.ndarray:
    """Return the best distinct poses of similar triples, best first.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    scale_range : (low, high)
    noise : Scale
        Tolerances of distances.
    candidates : (n, m) bool array, optional
        The feasible pairs.
    seed : int
    stop : (1,) uint8 array
        When it is set, the poses found so far are returned.

    Returns
    -------
    (P, 4, 4) array
        Similarities with scales in the range, up to the tolerance; none if no triples are similar.
    """
    unit, own_unit = rms_radius(target), rms_radius(source)
    if len(source) < 3 or len(target) < 3 or unit == 0.0 or own_unit == 0.0:
        return np.empty((0, 4, 4))
    rng = np.random.default_rng(seed)
    x, y = np.ascontiguousarray(source / own_unit), np.ascontiguousarray(target / unit)
    low, high = (scale * own_unit / unit for scale in scale_range)
    triples = long_triples(x, rng)[:N_TRIPLES]
    columns = np.sort(rng.permutation(len(y))[:MAX_TARGETS])
    feasible = np.empty((0, 0), np.bool_)
    if candidates is not None:
        feasible = np.ascontiguousarray(candidates[:, columns])
    looked = x[rng.permutation(len(x))[:MAX_LOOKED]]
    field = nearness_field(y, noise.reach, MAX_CELLS)
    poses = np.zeros((len(triples), KEPT_PER_TRIPLE, 3, 4))
    scores = np.zeros((len(triples), KEPT_PER_TRIPLE))
    some = y[columns]
    first, second, lengths, distances = pairs_by_length(some)
    order = np.argsort(distances, axis=1, kind="stable")
    ascending = np.take_along_axis(distances, order, axis=1)
    sides = side_lengths(x, triples)
    telling = sides.min(axis=1) > 2.0 * noise.tolerance
    triples, sides = triples[telling], sides[telling]
    # a target pair shorter than this would make nearly every target triple similar
    shortest = np.maximum(low * sides[:, 0] - noise.tolerance, 2.0 * noise.tolerance)
    ends = [
        np.searchsorted(lengths, shortest),
        np.searchsorted(lengths, high * sides[:, 0] + noise.tolerance),
    ]
    similar_triple_poses(
        triples, np.column_stack([sides, *ends]), (x, some), feasible,
        (first, second, distances, order, ascending),
        (noise.tolerance, looked, field, stop), poses, scores,
    )  # fmt: skip
    found = distinct_poses(poses.reshape(-1, 3, 4), scores.ravel(), MAX_POSES)
    found[:, :3, :3] *= unit / own_unit
    found[:, :3, 3] *= unit
    return found


def rounds_for(n_source: int, n_target: int, n_inliers: int, failure: float) -> int:
    """Return the number of rounds after which one had a triple of true pairs, but for this probability.

    All partners of a triple must be among the target points that form triples.
    """
    share = (n_inliers / n_source * min(1.0, MAX_TARGETS / n_target)) ** 3
    needed = np.log(failure) / np.log1p(-share) / N_TRIPLES if share < 1.0 else 0.0
    return int(np.clip(np.ceil(needed), AGREEING, MAX_ROUNDS))
