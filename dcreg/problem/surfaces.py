"""Lines, planes, circles, spheres and cylinders on which points lie, and the motions that keep them.

A few points show no direction of the surface that they sample, but they show whether all of them lie on
a surface of one of these kinds.
"""

from __future__ import annotations

import numpy as np

_DIRECTIONS, _NEAR, _ROUNDS = (
    100,
    40,
    6,
)  # axes of cylinders that are tried: everywhere, then near the best
_SHRINK = 0.35  # of the angles between the latter, for each round
_SOME = 50  # points that choose the axis
_HOPELESS = (
    4.0  # after two rounds, ratio of the deviation to the largest one at which the search ends
)


def surface_motions(points: np.ndarray, deviation: float, *, has_scale: bool) -> np.ndarray:
    """Return the motions that keep the surface on which points lie.

    Parameters
    ----------
    points : (k, d) array
    deviation : float
        Largest standard deviation of the points from the surface.
    has_scale : bool
        Whether the scale is free.

    Returns
    -------
    (q, p) array
        One motion per row: rotation, translation, and growth if the scale is free; empty if the points
        lie on no such surface. The surface of the lowest dimension counts, a plane before a sphere.
    """
    k, d = points.shape
    _, spread, axes = np.linalg.svd(points, full_matrices=False)
    squares = np.append(np.cumsum(spread[::-1] ** 2)[::-1], 0.0)

    def fits(square: float, parameters: int, codimension: int = 1) -> bool:
        spare = codimension * k - parameters
        return spare > 0 and square <= spare * deviation**2

    found: list[np.ndarray] = []
    if fits(squares[1], 2 * (d - 1), d - 1):
        found = [_motion(d, shift=axes[0])]
    elif d == 3 and fits(squares[2], 3):
        found = [_motion(3, shift=axes[0]), _motion(3, shift=axes[1]), _motion(3, axes[2])]
    if found:
        growth = [_motion(d, growth=1.0)] if has_scale else []
        return np.array([*found, *growth])[:, : None if has_scale else -1]
    centre, square = _sphere(points)
    if fits(float(square), d + 1):
        turns = np.ones((1, 1)) if d == 2 else np.eye(3)
        found = [_motion(d, turn, centre=centre) for turn in turns]
    elif d == 3:
        axis, centre, left = _cylinder(points, deviation)
        if fits(left, 5):
            found = [_motion(3, axis, centre=centre), _motion(3, shift=axis)]
    size = 2 * d + (d == 3)
    return np.array(found).reshape(-1, size)[:, : None if has_scale else -1]


def _motion(
    d: int,
    turn: np.ndarray | None = None,
    shift: np.ndarray | None = None,
    growth: float = 0.0,
    centre: np.ndarray | None = None,
) -> np.ndarray:
    """Return a motion as one vector; a rotation about `centre` also shifts the origin."""
    turn = np.zeros(1 if d == 2 else 3) if turn is None else turn
    shift = np.zeros(d) if shift is None else shift
    if centre is not None:
        shift = shift - (
            turn[0] * np.array([-centre[1], centre[0]]) if d == 2 else np.cross(turn, centre)
        )
    return np.concatenate([turn, shift, [growth]])


def _sphere(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (..., d) of spheres or circles through (..., k, d) points, and sums of squares.

    The centre minimises the sum of squares of ``|x - c|^2 - r^2``. The sums are those of the distances
    from the sphere.
    """
    mean = points.mean(axis=-2, keepdims=True)
    off = points - mean
    unit = np.sqrt((off**2).mean()) or 1.0
    off = off / unit
    known = np.concatenate([2.0 * off, np.ones((*off.shape[:-1], 1))], axis=-1)
    normal = np.swapaxes(known, -1, -2) @ known + 1e-12 * np.eye(known.shape[-1])
    right = np.swapaxes(known, -1, -2) @ (off**2).sum(axis=-1, keepdims=True)
    solved = np.linalg.solve(normal, right)[..., 0]
    centre = solved[..., :-1]
    radius = np.sqrt(np.maximum(solved[..., -1] + (centre**2).sum(axis=-1), 0.0))
    gaps = np.linalg.norm(off - centre[..., None, :], axis=-1) - radius[..., None]
    return centre * unit + mean[..., 0, :], unit**2 * (gaps**2).sum(axis=-1)


def _cylinder(points: np.ndarray, deviation: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the axis, a point on it and the sum of squares of the best cylinder found."""
    steps = np.arange(_DIRECTIONS) + 0.5  # a spiral over the hemisphere
    height, angle = 1.0 - steps / _DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * steps
    radius = np.sqrt(1.0 - height**2)
    tried = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    around = np.random.default_rng(0).standard_normal((_NEAR, 3))
    some = points[:: -(-len(points) // _SOME)]
    width = 2.0 / np.sqrt(_DIRECTIONS)
    for number in range(_ROUNDS):
        across = _across(tried)
        best = int(_sphere(some @ across)[1].argmin())
        axis, found = tried[best], across[best]
        centre, square = _sphere(points @ found)
        if number > 1 and square > len(points) * (_HOPELESS * deviation) ** 2:
            break
        tried = np.vstack([axis, axis + width * around])
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        width *= _SHRINK
    return axis, found @ centre, float(square)


def _across(axes: np.ndarray) -> np.ndarray:
    """Return (a, 3, 2) orthonormal bases of the planes across unit vectors."""
    other = np.eye(3)[np.abs(axes).argmin(axis=1)]
    first = np.cross(axes, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(axes, first)], axis=2)
