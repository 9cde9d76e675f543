"""Initial poses of a search in 2D if many points have no partner: similarities of pairs of points.

Two source points and two target points determine a similarity. Among enough random source pairs one
consists of points with a partner, and one of all target pairs is the right one for it. The score of a
pose is the number of source points near the target. The best distinct poses are returned.
"""

from __future__ import annotations

import numpy as np

from dcreg.families.similarity2d.kernels.vertices import pair_poses
from dcreg.families.starts import distinct, in_3d, nearness_field
from dcreg.jit import NEVER
from dcreg.problem import rms_radius

REACH = 0.08  # distance within which a point is near the target, in RMS radii
FAILURE = 1e-3  # accepted probability that no source pair consists of points with a partner
MIN_PAIRS, MAX_PAIRS = 12, 60
MAX_TARGETS = 200  # target points that form pairs
MAX_LOOKED = 60  # source points used for the score
KEPT_PER_PAIR = 12
MAX_POSES = 48
MAX_CELLS = 2000  # of the nearness field along the longest side: 32 MB
SEPARATION = 0.15  # poses whose parameters, in units of the clouds, differ by less count as one


def similar_poses(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    scale_range: tuple[float, float],
    candidates: np.ndarray | None = None,
    *,
    stop: np.ndarray = NEVER,
) -> np.ndarray:
    """Return the best distinct similarities of pairs of points, best first.

    Parameters
    ----------
    source, target : (n, 2), (m, 2) arrays
        Centred, in units in which their extents are near one.
    n_inliers : int
    scale_range : (low, high)
    candidates : (n, m) bool array, optional
        The feasible pairs.
    stop : (1,) uint8 array
        When it is set, the poses found so far are returned.

    Returns
    -------
    (P, 4) array
        Parameters ``(s cos a, s sin a, t_x, t_y)``; none if all points coincide.
    """
    unit = rms_radius(target)
    if len(source) < 2 or len(target) < 2 or unit == 0.0 or rms_radius(source) == 0.0:
        return np.empty((0, 4))
    rng = np.random.default_rng(0)
    pairs = _long_pairs(source, n_inliers, rng)
    columns = np.sort(rng.permutation(len(target))[:MAX_TARGETS])
    feasible = np.empty((0, 0), np.bool_)
    if candidates is not None:
        feasible = np.ascontiguousarray(candidates[:, columns])
    source, target = np.ascontiguousarray(source), np.ascontiguousarray(target)
    looked = in_3d(source[rng.permutation(len(source))[:MAX_LOOKED]])
    field = nearness_field(target, REACH * unit, MAX_CELLS)
    thetas = np.zeros((len(pairs), KEPT_PER_PAIR, 4))
    scores = np.zeros((len(pairs), KEPT_PER_PAIR))
    pair_poses(
        pairs, source, target[columns], feasible,
        (looked, field, *map(float, scale_range), stop), thetas, scores,
    )  # fmt: skip
    found = thetas.reshape(-1, 4)
    return found[distinct(found / [1.0, 1.0, unit, unit], scores.ravel(), SEPARATION, MAX_POSES)]


def _long_pairs(points: np.ndarray, n_inliers: int, rng: np.random.Generator) -> np.ndarray:
    """Draw random pairs farther apart than most, enough for one of points with a partner."""
    share = (n_inliers / len(points)) ** 2
    needed = np.log(FAILURE) / np.log1p(-share) if share < 1.0 else 0.0
    count = int(np.clip(needed, MIN_PAIRS, MAX_PAIRS))
    drawn = rng.integers(len(points), size=(4 * count, 2))
    lengths = np.linalg.norm(points[drawn[:, 0]] - points[drawn[:, 1]], axis=1)
    longest = np.argsort(-lengths, kind="stable")[: 2 * count]
    longest = longest[lengths[longest] > 0.0]
    return drawn[longest[np.sort(rng.permutation(len(longest))[:count])]]
