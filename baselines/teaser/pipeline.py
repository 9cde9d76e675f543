"""TEASER's decoupled estimation: scale, then rotation, then translation, on a maximum clique."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from baselines._shared.cliques import Clique, maximum_clique
from baselines._shared.consistency import vote_scale, vote_translation
from baselines._shared.kernels.lengths import consistency_graph
from baselines._shared.poses import homogeneous
from baselines._shared.robust import gnc_rotation
from dcreg.search import Budget

SHARE_FOR_CLIQUE = 0.9  # of the time left; rotation and translation take milliseconds


@dataclass(frozen=True)
class TeaserResult:
    """The pose (None if the clique determines none), and what each step proves."""

    pose: np.ndarray | None
    clique: Clique
    finished: bool
    n_rotation_inliers: int = 0
    n_inliers: int = 0


def register(
    source: np.ndarray,
    target: np.ndarray,
    pairs: np.ndarray,
    noise_bound: float,
    scale_range: tuple[float, float],
    budget: Budget,
) -> TeaserResult:
    """Estimate the pose of corresponding rows of `source` and `target`.

    Parameters
    ----------
    source, target : (n, d) arrays
    pairs : (n, 2) array
        Indices of the points of the rows; two rows that share a point are never both chosen.
    noise_bound : float
        Maximum residual of an inlier.
    budget : Budget
        If it is over, the clique may not be the maximum one.
    """
    # Differences of correspondences are invariant to translation, with noise of at most twice the
    # bound. Their lengths are also invariant to rotation.
    tolerance = 2 * noise_bound
    scale = vote_scale(source, target, tolerance, scale_range)
    rows = consistency_graph(source, target, pairs, tolerance, scale)
    clique = maximum_clique(rows, budget.sub_budget(SHARE_FOR_CLIQUE))
    members = clique.vertices
    if len(members) < source.shape[1]:
        return TeaserResult(None, clique, not clique.is_cut)
    following = np.roll(members, -1)  # a closed chain of differences through the clique
    rotation, weights, finished = gnc_rotation(
        scale * (source[following] - source[members]),
        target[following] - target[members],
        tolerance,
        budget,
    )
    turned = scale * source @ rotation.T
    translation = vote_translation(turned[members], target[members], noise_bound)
    off = np.linalg.norm(turned + translation - target, axis=1)
    return TeaserResult(
        homogeneous(scale, rotation, translation),
        clique,
        finished and not clique.is_cut,
        int((weights >= 0.5).sum()),
        int((off <= noise_bound).sum()),
    )
