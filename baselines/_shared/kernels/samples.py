"""Compiled poses of small samples and their inliers; see `baselines._shared.ransac`."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit


@jit
def count_within(source, target, pose, bound):
    """Count the rows whose moved source is within `bound` of the target."""
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


@jit
def count_inliers(source, target, samples, bound, low, high):
    """Count the inliers of the pose of each sample; 0 if its lengths are inconsistent."""
    counts = np.zeros(len(samples), dtype=np.int64)
    d = source.shape[1]
    for k in range(len(samples)):
        rows = samples[k]
        if _agrees(source, target, rows, 2 * bound, low, high):
            pose = _sample_pose(source, target, rows, low, high)
            counts[k] = count_within(source, target, pose, bound) if pose[d, d] > 0 else 0
    return counts


@jit
def _agrees(source, target, rows, tolerance, low, high):
    """Return whether no point repeats and all lengths of the sample are consistent."""
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


@jit
def _sample_pose(source, target, rows, low, high):
    """Return the least-squares pose of the sample; all zero if it is degenerate."""
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
