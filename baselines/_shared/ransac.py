"""Samples of correspondences, as few as fix a pose, and the pose that most others agree with."""

from __future__ import annotations

import time

import numpy as np
from numba import njit

from baselines._shared.robust import refit
from dcreg.local import fit_pose

BATCH = 500  # samples between two looks at the clock: a millisecond


def ransac(
    source: np.ndarray,
    target: np.ndarray,
    bound: float,
    scale_range: tuple[float, float],
    *,
    seed: int,
    max_samples: int,
    confidence: float,
    deadline: float = np.inf,
) -> tuple[np.ndarray | None, int, bool]:
    """The refitted pose with the most residuals within `bound`.

    Ends when a sample of true correspondences has been drawn with probability `confidence`, judged
    by the share of inliers of the best pose.

    Returns
    -------
    pose, n_samples, finished
    """
    n, d = source.shape
    generator = np.random.default_rng(seed)
    best, most, drawn, needed = None, d - 1, 0, max_samples
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
        if time.perf_counter() > deadline:
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
    """Samples whose pose has more than `most` inliers, with the number."""
    counts = _inliers(source, target, samples, bound, *scale_range)
    good = np.flatnonzero(counts > most)
    good = good[np.argsort(-counts[good], kind="stable")]
    return [(int(k), int(counts[k])) for k in good]


def _count(pose: np.ndarray, source: np.ndarray, target: np.ndarray, bound: float) -> int:
    return int(count_within(source, target, pose, bound))


@njit(cache=True)
def count_within(source, target, pose, bound):
    """Number of rows whose moved source is within `bound` of the target."""
    n, d = source.shape
    count = 0
    for i in range(n):
        off = 0.0
        for a in range(d):
            value = pose[a, d] - target[i, a]
            for b in range(d):
                value += pose[a, b] * source[i, b]
            off += value * value
        if off <= bound * bound:
            count += 1
    return count


@njit(cache=True)
def _inliers(source, target, samples, bound, low, high):
    """Number of inliers of the pose of each sample; 0 for one whose lengths do not agree."""
    counts = np.zeros(len(samples), dtype=np.int64)
    d = source.shape[1]
    for k in range(len(samples)):
        rows = samples[k]
        if _agrees(source, target, rows, 2 * bound, low, high):
            pose = _sample_pose(source, target, rows, low, high)
            counts[k] = count_within(source, target, pose, bound) if pose[d, d] > 0 else 0
    return counts


@njit(cache=True)
def _agrees(source, target, rows, tolerance, low, high):
    """No point twice, and every length of the sample can be that of the other set."""
    for a in range(len(rows)):
        for b in range(a):
            x, y = 0.0, 0.0
            for c in range(source.shape[1]):
                x += (source[rows[a], c] - source[rows[b], c]) ** 2
                y += (target[rows[a], c] - target[rows[b], c]) ** 2
            x, y = np.sqrt(x), np.sqrt(y)
            if x <= tolerance or y < low * x - tolerance or y > high * x + tolerance:
                return False
    return True


@njit(cache=True)
def _sample_pose(source, target, rows, low, high):
    """Least-squares pose of the sample; all zero where it is degenerate."""
    d = source.shape[1]
    size = len(rows)
    mean_x, mean_y = np.zeros(d), np.zeros(d)
    for r in rows:
        mean_x += source[r] / size
        mean_y += target[r] / size
    cross, spread = np.zeros((d, d)), 0.0
    for r in rows:
        for a in range(d):
            for b in range(d):
                cross[a, b] += (target[r, a] - mean_y[a]) * (source[r, b] - mean_x[b])
            spread += (source[r, a] - mean_x[a]) ** 2
    pose = np.zeros((d + 1, d + 1))
    u, singular, vt = np.linalg.svd(cross)
    if spread == 0 or not np.isfinite(singular).all() or singular[d - 2] <= 1e-12 * singular[0]:
        return pose
    if np.linalg.det(u) * np.linalg.det(vt) < 0:
        u[:, d - 1] *= -1
        singular[d - 1] *= -1
    rotation = u @ vt
    scale = min(max(singular.sum() / spread, low), high)
    for a in range(d):
        pose[a, d] = mean_y[a]
        for b in range(d):
            pose[a, b] = scale * rotation[a, b]
            pose[a, d] -= scale * rotation[a, b] * mean_x[b]
    pose[d, d] = 1.0
    return pose
