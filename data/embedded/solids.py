"""Two animal-like solids: smooth unions of tapered limbs, sampled by farthest points.

x points forward, y to the animal's left, z up. Both animals walk, turn the head and swing the
tail, because a mirror-symmetric solid has two optimal translations in norm space and only one of
them belongs to a proper rotation.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from data.sampling import farthest_points

# A limb: (start, radius there), (end, radius there).
Limb = tuple[tuple[float, float, float], float, tuple[float, float, float], float]


def _chain(*joints: tuple[float, float, float, float]) -> list[Limb]:
    """Limbs through joints (x, y, z, radius)."""
    return [(a[:3], a[3], b[:3], b[3]) for a, b in pairwise(joints)]


PONY: list[Limb] = [
    *_chain((-0.42, 0.0, 0.02, 0.185), (0.0, 0.01, -0.02, 0.19), (0.38, 0.0, 0.03, 0.17)),  # trunk
    *_chain((0.42, 0.0, 0.12, 0.14), (0.60, 0.06, 0.36, 0.095), (0.68, 0.12, 0.50, 0.08)),  # neck
    *_chain((0.68, 0.12, 0.52, 0.085), (0.84, 0.22, 0.40, 0.06), (0.91, 0.27, 0.33, 0.045)),  # head
    *_chain((0.66, 0.155, 0.58, 0.03), (0.66, 0.18, 0.68, 0.012)),  # left ear
    *_chain((0.69, 0.075, 0.58, 0.03), (0.72, 0.06, 0.67, 0.012)),  # right ear
    # fore legs: the left one reaches out, the right one is raised
    *_chain((0.36, 0.12, -0.08, 0.085), (0.50, 0.13, -0.40, 0.05), (0.58, 0.13, -0.74, 0.035)),
    *_chain((0.58, 0.13, -0.74, 0.04), (0.64, 0.13, -0.78, 0.04)),
    *_chain((0.36, -0.12, -0.08, 0.085), (0.42, -0.13, -0.40, 0.05), (0.24, -0.13, -0.58, 0.033)),
    *_chain((0.24, -0.13, -0.58, 0.036), (0.19, -0.13, -0.63, 0.036)),
    # hind legs, in opposite phase
    *_chain((-0.44, 0.12, -0.05, 0.115), (-0.42, 0.14, -0.38, 0.055)),
    *_chain((-0.42, 0.14, -0.38, 0.055), (-0.62, 0.14, -0.72, 0.036), (-0.57, 0.14, -0.78, 0.04)),
    *_chain((-0.44, -0.12, -0.05, 0.115), (-0.30, -0.14, -0.40, 0.055)),
    *_chain(
        (-0.30, -0.14, -0.40, 0.055), (-0.36, -0.14, -0.75, 0.036), (-0.30, -0.14, -0.78, 0.04)
    ),
    # tail, swung to the right
    *_chain((-0.58, 0.0, 0.10, 0.05), (-0.74, -0.09, 0.02, 0.055), (-0.80, -0.15, -0.32, 0.03)),
]

SAURIAN: list[Limb] = [
    *_chain((-0.22, 0.0, 0.02, 0.15), (0.0, 0.0, 0.05, 0.185), (0.20, 0.02, 0.09, 0.14)),  # trunk
    # neck in an S, head turned to the left
    *_chain((0.24, 0.03, 0.12, 0.10), (0.42, 0.08, 0.28, 0.068), (0.50, 0.13, 0.48, 0.055)),
    *_chain((0.50, 0.13, 0.48, 0.055), (0.54, 0.17, 0.60, 0.055)),
    *_chain((0.54, 0.18, 0.63, 0.075), (0.66, 0.28, 0.60, 0.05), (0.71, 0.33, 0.58, 0.035)),
    # tail, long and swung to the right
    *_chain((-0.26, 0.0, 0.0, 0.13), (-0.50, -0.05, -0.08, 0.085), (-0.74, -0.17, -0.15, 0.052)),
    *_chain(
        (-0.74, -0.17, -0.15, 0.052), (-0.92, -0.32, -0.19, 0.03), (-1.02, -0.46, -0.17, 0.012)
    ),
    # hind legs, heavy, mid-stride
    *_chain((-0.14, 0.12, -0.03, 0.115), (0.0, 0.17, -0.25, 0.07), (-0.10, 0.17, -0.47, 0.045)),
    *_chain((-0.10, 0.17, -0.48, 0.045), (0.06, 0.19, -0.50, 0.03)),
    *_chain(
        (-0.14, -0.12, -0.03, 0.115), (-0.22, -0.17, -0.27, 0.07), (-0.36, -0.17, -0.45, 0.045)
    ),
    *_chain((-0.36, -0.17, -0.46, 0.045), (-0.22, -0.19, -0.50, 0.03)),
    # short arms, one lifted
    *_chain((0.20, 0.11, 0.02, 0.05), (0.30, 0.16, -0.10, 0.036), (0.40, 0.15, -0.06, 0.022)),
    *_chain((0.20, -0.10, 0.02, 0.05), (0.27, -0.16, -0.13, 0.036), (0.33, -0.16, -0.24, 0.022)),
    # plates along the back
    *_chain((-0.30, 0.0, 0.15, 0.04), (-0.34, 0.0, 0.25, 0.014)),
    *_chain((-0.12, 0.0, 0.20, 0.05), (-0.15, 0.0, 0.33, 0.016)),
    *_chain((0.08, 0.01, 0.22, 0.05), (0.06, 0.01, 0.33, 0.016)),
]

BLEND = 0.02  # width of the smooth transition between limbs


def sample_solid(limbs: list[Limb], n_points: int) -> np.ndarray:
    """Return `n_points` points of the surface of the smooth union, by farthest-point sampling."""
    start, r0, end, r1 = (np.array(column, dtype=float) for column in zip(*limbs, strict=True))
    dense = np.vstack(
        [_limb_surface(*limb, count=max(200, 8 * n_points // len(limbs))) for limb in limbs]
    )
    for _ in range(8):  # Newton steps onto the surface; points inside the union drift out
        value, gradient = _distance(dense, start, r0, end, r1)
        dense = dense - value[:, None] * gradient
    value, _ = _distance(dense, start, r0, end, r1)
    surface = dense[np.abs(value) < 1e-6]
    return surface[farthest_points(surface, n_points)]


def _limb_surface(
    start: tuple[float, ...], r0: float, end: tuple[float, ...], r1: float, count: int
) -> np.ndarray:
    """Return points around a limb on a Fibonacci spiral, without random numbers."""
    a, b = np.array(start), np.array(end)
    length = np.linalg.norm(b - a)
    axis = (b - a) / length
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    u = (np.arange(count) + 0.5) / count
    along = -r0 + u * (length + r0 + r1)  # caps included
    radius = r0 + (r1 - r0) * np.clip(along / length, 0, 1)
    beyond = np.maximum(-along, np.maximum(along - length, 0))
    ring = np.sqrt(np.maximum(radius**2 - beyond**2, 0))
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
    return a + along[:, None] * axis + ring[:, None] * across


def _distance(
    points: np.ndarray, start: np.ndarray, r0: np.ndarray, end: np.ndarray, r1: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smooth minimum of the distances to all limbs, and its normalised gradient."""
    axis = end - start
    offset = points[:, None, :] - start
    t = np.clip((offset * axis).sum(-1) / (axis**2).sum(-1), 0, 1)
    away = offset - t[..., None] * axis
    norm = np.maximum(np.linalg.norm(away, axis=-1), 1e-12)
    limb = norm - (r0 + t * (r1 - r0))
    lowest = limb.min(axis=1, keepdims=True)
    weight = np.exp((lowest - limb) / BLEND)
    value = lowest[:, 0] - BLEND * np.log(weight.sum(axis=1))
    gradient = (weight[..., None] * away / norm[..., None]).sum(axis=1)
    gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    return value, gradient
