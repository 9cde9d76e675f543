"""How sure each direction of a pose is: its covariance, and directions in which the clouds can slide.

A small change of a pose T is ``T Exp(xi)``, a twist applied to the source first: rotation, then
translation, then the logarithm of the scale of a similarity. GTSAM and small_gicp use the same order and
side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dcreg.problem.geometry import apply_pose, nearest_rotation, rms_radius
from dcreg.problem.pose_range import PoseRange
from dcreg.problem.trees import tree_of

# A direction is open if moving along it raises the mean squared distance to the target by less than this
# share of the largest rise in any direction. With at least 200 points, shapes have 0.2 to 0.6 in their
# weakest direction, and planes, cylinders, spheres, lines and corridors at most 0.13.
OPEN = 0.15
MOST_CONDITION = 1e10  # of the normal matrix; pairs on a line determine no pose
FEW_POINTS = 200  # of the target; fewer do not show the directions of their surface
# Points of each cloud from which a surface is recognised. They lie on it if their standard deviation from
# it is at most `ON_SURFACE` point spacings at FEW_POINTS points (proportional to a power of the number),
# or `THIN` of their RMS radius. Points of other shapes (animals, boxes, balls) deviate more.
LEAST_POINTS, ON_SURFACE, ON_SURFACE_POWER, THIN = 10, 0.5, 0.75, 0.05
# As OPEN and _STEP, for the motions that keep such a surface. Outlines in a plane rise by 0.4 or more
# across, planes of 50 points by less than 0.3.
_OPEN_OF_FEW, _STEP_OF_FEW = 0.4, 1.5
_STEP = 3.0  # length of a move, in point spacings
# RMS distance at the pose in point spacings, below which both clouds have the same points. Their noise is
# then too small for sliding.
_SAME_POINTS = 0.5
_SAMPLED = 500  # pairs, evenly spaced, whose distances are compared
_NEIGHBOURS = {2: 6, 3: 11}  # that show the direction of a curve or surface
_DENSE = 100_000  # distances computed one by one, without loading SciPy

Nearest = Callable[[np.ndarray, int], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class OpenDirection:
    """A motion of the source along which the clouds slide on each other.

    The motion is given in the coordinates of the target, at the centroid of the moved points: per unit
    of RMS displacement, the points turn about the axis `rotation` by its length in radians and move by
    `translation`.

    Attributes
    ----------
    rotation : (3,) array, or (1,) array in 2D
    translation : (d,) array
    scale : float
        Relative growth; 0 if the scale is fixed.
    rise : float
        Rise of the mean squared distance to the target, divided by the largest rise in any direction;
        with fewer than 200 target points, divided by the mean squared displacement.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float
    rise: float


def pose_covariance(
    pose: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray | None = None,
    *,
    has_scale: bool = False,
    pose_range: PoseRange | None = None,
) -> np.ndarray | None:
    """Return the covariance of a least-squares pose, from the residuals of its pairs.

    The residuals of right pairs are assumed to be independent and equally large in all directions. Their
    variance is estimated from the pairs. The covariance is then ``variance * (sum J^T J)^-1`` with the
    Jacobians ``J`` of the moved points. With weights w, the variance of a residual is inversely
    proportional to w, and the matrix is ``sum w J^T J``. In a range of poses, the Jacobians are those of
    the motions that it leaves free, and the variance along all others is 0.

    Parameters
    ----------
    pose : (d+1, d+1) array
    source, target : (k, d) arrays
        Matched points.
    weights : (k,) array, optional
        Of the pairs; default: equal.
    has_scale : bool
        Whether the scale was free.
    pose_range : PoseRange, optional
        Checked; `pose` lies in it.

    Returns
    -------
    (6, 6) array in 3D, (7, 7) array in 3D with a free scale, (4, 4) array in 2D, or None
        Rotation (radians), translation (units of the source), logarithm of the scale (in 2D zeros if the
        scale is fixed), as a twist on the right of the pose. None if the pairs do not determine a pose,
        or if it lies at a limit of the range.
    """
    d = source.shape[1]
    if len(source) <= 1:
        return None
    if pose_range is not None and pose_range.is_at_limit(pose):
        return None
    centre = source.mean(axis=0)  # motions about it keep digits
    free = _free_motions(pose, centre, pose_range, has_scale=has_scale)
    jacobian = pose[:d, :d] @ _motions(source - centre, has_scale) @ free.T
    residuals = apply_pose(pose, source) - target
    if weights is not None:
        jacobian *= np.sqrt(weights)[:, None, None]
        residuals *= np.sqrt(weights)[:, None]
    normal = np.einsum("kia,kib->ab", jacobian, jacobian)
    spare = residuals.size - len(free)
    size = np.sqrt(np.diag(normal))
    if spare <= 0 or (size == 0.0).any():
        return None
    scaled = normal / np.outer(size, size)
    if np.linalg.cond(scaled) > MOST_CONDITION:
        return None
    variance = float((residuals**2).sum()) / spare
    of_free = variance * np.linalg.inv(scaled) / np.outer(size, size)
    shifted = np.eye(free.shape[1])
    shifted[_shift(d)] -= _motions(centre[None], has_scale)[0]
    shifted[_shift(d), _shift(d)] = np.eye(d)
    moves = shifted @ free.T
    covariance: np.ndarray = moves @ of_free @ moves.T
    return covariance


def _free_motions(
    pose: np.ndarray, centre: np.ndarray, pose_range: PoseRange | None, *, has_scale: bool
) -> np.ndarray:
    """Return the motions about `centre` that a range leaves free, as rows of (p,) twists."""
    d = len(centre)
    turns, places = (1, 4) if d == 2 else (3, 6 + has_scale)
    all_motions = np.eye(places)[: places - (d == 2 and not has_scale)]
    if pose_range is None:
        return all_motions
    rotations, rest = all_motions[:turns], all_motions[turns + d :]
    if pose_range.max_angle == 0.0:
        rotations = rotations[:0]
    elif pose_range.axis is not None:
        rotations = (nearest_rotation(pose[:d, :d]).T @ pose_range.axis)[None] @ rotations
    if pose_range.max_translation > 0.0:
        return np.vstack([rotations, all_motions[turns : turns + d], rest])
    about = np.vstack([rotations, rest])  # the pivot, which does not move
    moved = about @ _motions((pose_range.pivot - centre)[None], has_scale)[0].T
    return about - moved @ all_motions[turns : turns + d]


def _shift(d: int) -> slice:
    """Return the places of the translation in a twist."""
    return slice(3, 6) if d == 3 else slice(1, 3)


def open_directions(
    moved: np.ndarray, target: np.ndarray, *, has_scale: bool = False
) -> list[OpenDirection]:
    """Return the directions in which a cloud can slide on the target, as planes and cylinders do.

    From `FEW_POINTS` target points on, candidates follow from the local directions of curves and surfaces
    in the target. With fewer points, they are the motions that keep the line, plane, circle, sphere or
    cylinder on which all points lie. Each is tried: the cloud moves by three point spacings, or one and a
    half if there are few, and the distances of the clouds are compared.

    Parameters
    ----------
    moved : (k, d) array
        Matched points of the source at the pose.
    target : (m, d) array
    has_scale : bool
        Whether the scale is free.

    Returns
    -------
    list of OpenDirection
        Those that raise the distances least first. Empty if a cloud has fewer than `LEAST_POINTS`, or if
        both clouds have the same points.
    """
    d, is_few = target.shape[1], len(target) < FEW_POINTS
    if len(target) < LEAST_POINTS or len(moved) <= (LEAST_POINTS - 1 if is_few else d):
        return []
    points = moved[:: -(-len(moved) // _SAMPLED)]
    centred = points - points.mean(axis=0)
    nearest = _search(target, len(points))
    at_pose, places = nearest(points, 1)
    spacing = float(np.median(nearest(target[places[:, 0]], 2)[0][:, 1]))
    fit = float(np.sqrt((at_pose**2).mean()))
    if fit <= _SAME_POINTS * spacing:
        return []
    motions = _motions(centred, has_scale)[:, :, : None if d == 3 or has_scale else 3]
    if is_few:
        near = target[np.unique(places)]
        directions = _kept_surface(points, near, motions, spacing, has_scale=has_scale)
        shares = _shares_of_few(points, near, nearest, motions, directions, max(spacing, fit))
    else:
        directions = _candidates(motions, _normals(target, nearest, places[:, 0]))
        step = _STEP * max(spacing, fit)
        ends = [[points + s * step * (motions @ each) for s in (1.0, -1.0)] for each in directions]
        rises = [max((nearest(end, 1)[0] ** 2).mean() for end in both) - fit**2 for both in ends]
        shares = np.array(rises) / max(*rises, np.finfo(float).tiny)
    highest = _OPEN_OF_FEW if is_few else OPEN
    found = [
        _described(each, float(share), d)
        for each, share in zip(directions, shares, strict=True)
        if share < highest
    ]
    return sorted(found, key=lambda direction: direction.rise)


def _kept_surface(
    points: np.ndarray, near: np.ndarray, motions: np.ndarray, spacing: float, *, has_scale: bool
) -> np.ndarray:
    """Return motions of unit RMS displacement as rows: those that keep a surface through all points."""
    from dcreg.problem.surfaces import surface_motions  # clouds with the same points do not need it

    share = min(1.0, len(points) / FEW_POINTS) ** ON_SURFACE_POWER
    both = np.concatenate([points, near]) - points.mean(axis=0)
    deviation = max(ON_SURFACE * share * spacing, THIN * rms_radius(both))
    found = surface_motions(both, deviation, has_scale=has_scale)
    return found / np.sqrt(((motions @ found.T) ** 2).sum(axis=1).mean(axis=0))[:, None]


def _shares_of_few(
    points: np.ndarray,
    near: np.ndarray,
    nearest: Nearest,
    motions: np.ndarray,
    directions: np.ndarray,
    unit: float,
) -> np.ndarray:
    """Return by how much motions raise the squared distances, divided by the squared displacement.

    Distances of few points fluctuate. So both clouds are searched, and both senses of a motion count.
    """
    step = _STEP_OF_FEW * unit

    def apart(moved: np.ndarray) -> float:
        back = _search(moved, len(near))(near, 1)[0]
        return float((nearest(moved, 1)[0] ** 2).mean() + (back**2).mean())

    ends = [[points + s * step * (motions @ each) for s in (1.0, -1.0)] for each in directions]
    rises = [np.mean([apart(end) for end in both]) - apart(points) for both in ends]
    return np.array(rises) / (2.0 * step**2)


def _motions(points: np.ndarray, has_scale: bool) -> np.ndarray:
    """Return (k, d, p): the displacement of each point by a unit rotation, translation and growth.

    In 3D, growth is omitted if the scale is fixed.
    """
    k, d = points.shape
    shift = np.broadcast_to(np.eye(d), (k, d, d))
    if d == 2:
        turn = np.stack([-points[:, 1], points[:, 0]], axis=1)[:, :, None]
        return np.concatenate([turn, shift, points[:, :, None]], axis=2)
    turn = np.zeros((k, 3, 3))
    for i, j, l in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # axis i moves j to l
        turn[:, l, i], turn[:, j, i] = points[:, j], -points[:, l]
    parts = [turn, shift, points[:, :, None]] if has_scale else [turn, shift]
    return np.concatenate(parts, axis=2)


def _search(target: np.ndarray, queries: int) -> Nearest:
    """Return a function from points and a count to distances and rows of their nearest targets."""
    if queries * len(target) > _DENSE:
        return tree_of(target).neighbours

    def by_distances(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        squared = np.zeros((len(points), len(target)))
        for axis in range(target.shape[1]):
            squared += np.subtract.outer(points[:, axis], target[:, axis]) ** 2
        rows = np.argpartition(squared, count - 1, axis=1)[:, :count]
        near = np.take_along_axis(squared, rows, axis=1)
        order = np.argsort(near, axis=1, kind="stable")
        near = np.take_along_axis(near, order, axis=1)
        return np.sqrt(near), np.take_along_axis(rows, order, axis=1)

    return by_distances


def _normals(target: np.ndarray, nearest: Nearest, places: np.ndarray) -> np.ndarray:
    """Return (k, d, d): 0 along the curve or surface at a target point, up to 1 across it."""
    around = target[nearest(target[places], 1 + _NEIGHBOURS[target.shape[1]])[1]]
    off = around - around.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("kni,knj->kij", off, off))
    largest = np.maximum(spread[:, -1:], np.finfo(float).tiny)
    across = 1.0 - np.sqrt(np.clip(spread / largest, 0.0, 1.0))
    return np.einsum("kij,kj,klj->kil", axes, across, axes)


def _candidates(motions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return motions of unit RMS displacement as rows, the one least across the surface first."""
    k = len(motions)
    length = np.einsum("kia,kib->ab", motions, motions) / k
    across = np.einsum("kia,kij,kjb->ab", motions, normals, motions) / k
    size = np.sqrt(np.maximum(np.diag(length), np.finfo(float).tiny))
    length, across = length / np.outer(size, size), across / np.outer(size, size)
    factor = np.linalg.cholesky(length + 1e-9 * np.eye(len(length)))
    inverse = np.linalg.inv(factor)
    _, axes = np.linalg.eigh(inverse @ across @ inverse.T)
    found = (inverse.T @ axes).T / size
    moved = np.sqrt(np.einsum("pa,ab,pb->p", found * size, length, found * size))
    return found[moved > 0.5]  # a rotation about points on a line moves nothing


def _described(direction: np.ndarray, share: float, d: int) -> OpenDirection:
    turns = 1 if d == 2 else 3
    rotation, translation = direction[:turns], direction[turns : turns + d]
    scale = float(direction[turns + d]) if len(direction) > turns + d else 0.0
    return OpenDirection(rotation, translation, scale, max(0.0, share))
