"""Initial poses of a similarity search in 3D: poses of similar triples.

They are those of `dcreg.families.rigid3d.starts`, except that the scale is free: the ratios of the sides
of two triples agree, and their scale lies in the range. There are more such triples, so fewer target
points form them.
"""

from __future__ import annotations

import numpy as np

from dcreg.families.rigid3d.starts import Scale, TripleSearch
from dcreg.families.similarity3d.kernels.triples import similar_triple_poses
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
    x, y = np.ascontiguousarray(source / own_unit), np.ascontiguousarray(target / unit)
    search = TripleSearch.of(x, y, noise, candidates, seed, N_TRIPLES, MAX_TARGETS)
    low, high = (scale * own_unit / unit for scale in scale_range)
    first_side = search.sides[:, 0]
    # a target pair shorter than this would make nearly every target triple similar
    shortest = np.maximum(low * first_side - noise.tolerance, 2.0 * noise.tolerance)
    ends = [
        np.searchsorted(search.lengths, shortest),
        np.searchsorted(search.lengths, high * first_side + noise.tolerance),
    ]
    found = search.best(similar_triple_poses, [search.sides, *ends], stop)
    found[:, :3, :3] *= unit / own_unit
    found[:, :3, 3] *= unit
    return found
