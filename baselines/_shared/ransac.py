"""RANSAC over minimal samples of correspondences."""

from __future__ import annotations

import numpy as np

from baselines._shared.kernels.samples import count_inliers, count_within
from baselines._shared.robust import refit
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

BATCH = 500  # samples between two checks of the budget, about a millisecond


def ransac(
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    scale_range: tuple[float, float],
    *,
    seed: int,
    max_samples: int,
    confidence: float,
    budget: Budget,
) -> tuple[np.ndarray | None, int, bool]:
    """Return the refitted pose with the most residuals within `bound`.

    Stops when a sample of inliers has been drawn with probability `confidence`, estimated from the
    inlier share of the best pose, or when the budget is over.

    Returns
    -------
    pose, n_samples, finished
    """
    n, d = source.shape
    generator = np.random.default_rng(seed)
    best: np.ndarray | None = None
    most, drawn, needed = d - 1, 0, float(max_samples)
    while drawn < needed:
        samples = generator.integers(n, size=(BATCH, d))
        for k, count in _promising(source, target, samples, bound, scale_range, most):
            if count <= most:
                continue
            rows = samples[k]
            pose = fit_pose(source[rows], target[rows], scale_range)
            pose = refit(pose, source, target, bound, scale_range)
            best, most = pose, max(most, _count(pose, source, target, bound))
        drawn += BATCH
        if best is not None:
            needed = min(max_samples, _samples_needed(most / n, d, confidence))
        if budget.is_over:
            return best, drawn, drawn >= needed
    return best, drawn, True


def _samples_needed(inlier_share: float, size: int, confidence: float) -> float:
    chance = inlier_share**size
    return 0.0 if chance >= 1 else np.log1p(-confidence) / np.log1p(-chance)


def _promising(
    source: np.ndarray,
    target: np.ndarray,
    samples: np.ndarray,
    bound: float,
    scale_range: tuple[float, float],
    most: int,
) -> list[tuple[int, int]]:
    """Return the samples whose pose has more than `most` inliers, with the number of inliers."""
    counts = count_inliers(source, target, samples, bound, *scale_range)
    good = np.flatnonzero(counts > most)
    good = good[np.argsort(-counts[good], kind="stable")]
    return [(int(k), int(counts[k])) for k in good]


def _count(pose: np.ndarray, source: np.ndarray, target: np.ndarray, bound: float) -> int:
    return int(count_within(source, target, pose, bound))
