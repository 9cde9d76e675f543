"""TurboReg, a port: triangles of consistent correspondences from the most promising pairs."""

from __future__ import annotations

import numpy as np

from baselines._shared.consistency import length_differences, sharing
from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.kernels.samples import count_inliers
from baselines.contract import Instance
from baselines.sc2_pcr.consensus import refine
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

BATCH = 50  # pivots between two checks of the budget


class Adapter(CorrespondenceMethod):
    """The triangle whose pose has the most inliers, refined."""

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        bound = self.inlier_distance(instance)
        scores = ordered_scores(source, target, pairs, self.options["length_factor"] * bound)
        pivots = greatest(scores, self.options["pivots"])
        best, most, n_triangles = None, 0, 0
        for start in range(0, len(pivots), BATCH):
            found = triangles(scores, pivots[start : start + BATCH], self.options["triangles"])
            n_triangles += len(found)
            counts = count_inliers(source, target, found, bound, 1.0, 1.0)
            if len(counts) and counts.max() > most:
                best, most = found[counts.argmax()], int(counts.max())
            if budget.is_over:
                break
        finished = start + BATCH >= len(pivots) if len(pivots) else True
        if best is None:
            return Estimate(None, finished)
        pose = refine(fit_pose(source[best], target[best], (1.0, 1.0)), source, target, bound)
        return Estimate(pose, finished, extra={"triangles": float(n_triangles)})


def ordered_scores(
    source: np.ndarray, target: np.ndarray, pairs: np.ndarray, tolerance: float
) -> np.ndarray:
    """Count the neighbours shared by consistent correspondences i < j; 0 for all others.

    The order assigns every triangle to a single pivot, its two lowest indices.
    """
    consistent = (length_differences(source, target) <= tolerance) & ~sharing(pairs)
    graph = consistent.astype(np.float32)
    return np.triu(graph * (graph @ graph), 1)


def greatest(scores: np.ndarray, most: int) -> np.ndarray:
    """Return the places (i, j) of at most `count` positive scores, the greatest first."""
    rows, columns = np.nonzero(scores)
    order = np.argsort(-scores[rows, columns], kind="stable")[:most]
    return np.column_stack([rows[order], columns[order]])


def triangles(scores: np.ndarray, pivots: np.ndarray, per_pivot: int) -> np.ndarray:
    """Return for every pivot (i, j) the triangles (i, j, k) with the greatest sums of scores."""
    first, second = scores[pivots[:, 0]], scores[pivots[:, 1]]
    sums = np.where((first > 0) & (second > 0), first + second, 0.0)
    thirds = np.argsort(-sums, axis=1, kind="stable")[:, :per_pivot]
    pivot, place = np.nonzero(np.take_along_axis(sums, thirds, axis=1))
    return np.column_stack([pivots[pivot], thirds[pivot, place]])
