"""Pose graphs as g2o files, which g2o, GTSAM and Ceres read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dcreg.files import write_text
from dcreg.problem import InputError, rotation_angle_deg, scale_of

_SAME_SCALE = 1e-6
_SINGULAR = 1e-14  # ratio of eigenvalues of a correlation matrix; rounding explains smaller ones
# Places in a covariance of this library, in the order of g2o, and the factor of each coordinate: g2o
# measures a rotation in 3D by the vector part of its quaternion, half of the rotation vector.
_ORDER = {2: [1, 2, 0], 3: [3, 4, 5, 0, 1, 2]}
_FACTOR = {2: [1.0, 1.0, 1.0], 3: [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]}
_TAGS = {2: "SE2", 3: "SE3:QUAT"}


class PoseEdge(NamedTuple):
    """The pose of one cloud relative to another one.

    Attributes
    ----------
    source, target : int
        Numbers of the clouds.
    T_target_source : (d+1, d+1) array
        Rigid pose, such as `Result.T_target_source`.
    covariance : (6, 6) array in 3D, (4, 4) array in 2D, optional
        Such as `Result.covariance`: rotation first.
    """

    source: int
    target: int
    T_target_source: np.ndarray
    covariance: np.ndarray | None = None


def write_pose_graph(path: str | Path, edges: Iterable[PoseEdge]) -> list[PoseEdge]:
    """Write poses between pairs of clouds as a pose graph in the format of g2o.

    Each edge leads from the target to the source: its measurement is the pose of the source in the frame
    of the target. The information matrix is the inverse of the covariance, in the coordinates of g2o:
    translation, then the vector part of the quaternion (3D) or the angle (2D). The vertices have initial
    poses that follow from the edges; the first vertex of each connected part is at the origin.

    Parameters
    ----------
    path : str or Path
        It is written completely or not at all.
    edges : iterable of PoseEdge
        All in 2D, or all in 3D.

    Returns
    -------
    list of PoseEdge
        Edges without a covariance that can be inverted. Their information is the identity.

    Raises
    ------
    InputError
        If a pose scales its cloud, or the dimensions differ.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> T = np.eye(4)
    >>> T[:3, 3] = 1.0, 2.0, 3.0
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "poses.g2o"
    ...     _ = write_pose_graph(path, [PoseEdge(1, 0, T, np.eye(6))])
    ...     print(path.read_text().splitlines()[1])
    VERTEX_SE3:QUAT 1 1.0 2.0 3.0 0.0 0.0 0.0 1.0
    """
    edges = list(edges)
    for edge in edges:
        _check(edge, edges[0].T_target_source.shape)
    lines = [
        f"VERTEX_{_TAGS[len(T) - 1]} {vertex} {_numbers(_pose(T))}"
        for vertex, T in sorted(_initial_poses(edges).items())
    ]
    without = []
    for edge in edges:
        d = len(edge.T_target_source) - 1
        information = _information(edge.covariance, d)
        if information is None:
            without.append(edge)
            information = np.eye(len(_ORDER[d]))
        upper = information[np.triu_indices(len(information))]
        pose = _pose(edge.T_target_source)
        ends = f"{edge.target} {edge.source}"
        lines.append(f"EDGE_{_TAGS[d]} {ends} {_numbers(pose)} {_numbers(upper)}")
    write_text(path, "".join(f"{line}\n" for line in lines))
    return without


def _check(edge: PoseEdge, shape: tuple[int, ...]) -> None:
    """Refuse a pose that g2o cannot hold."""
    T, ends = edge.T_target_source, f"{edge.source} to {edge.target}"
    if T.shape != shape or T.shape not in ((3, 3), (4, 4)):
        raise InputError(
            f"edges: the pose of {ends} has shape {T.shape}; give poses of one dimension, 2 or 3"
        )
    if abs(scale_of(T) - 1.0) > _SAME_SCALE:
        raise InputError(
            f"edges: the pose of {ends} has scale {scale_of(T):.6g}; g2o holds rigid poses only, so fix "
            "the scale with scale_range=(1, 1)"
        )


def _initial_poses(edges: Sequence[PoseEdge]) -> dict[int, np.ndarray]:
    """Return the pose of each vertex, from the edges of a spanning tree."""
    near: dict[int, list[tuple[int, np.ndarray]]] = {}
    for source, target, T, _ in edges:
        near.setdefault(target, []).append((source, T))
        near.setdefault(source, []).append((target, np.linalg.inv(T)))
    poses: dict[int, np.ndarray] = {}
    for root in sorted(near):
        if root in poses:
            continue
        poses[root] = np.eye(len(near[root][0][1]))
        found = [root]
        for vertex in found:
            for other, T in near[vertex]:
                if other not in poses:
                    poses[other] = poses[vertex] @ T
                    found.append(other)
    return poses


def _pose(T: np.ndarray) -> np.ndarray:
    """Return the numbers of a pose: translation, then quaternion x y z w or angle."""
    if len(T) == 3:
        return np.array([*T[:2, 2], np.radians(rotation_angle_deg(T[:2, :2]))])
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(T[:3, :3]).as_quat()
    return np.array([*T[:3, 3], *(turn if turn[3] >= 0.0 else -turn)])


def _information(covariance: np.ndarray | None, d: int) -> np.ndarray | None:
    """Return the information matrix of g2o, or None if there is none."""
    if covariance is None or not np.isfinite(covariance).all():
        return None
    order, factor = _ORDER[d], _FACTOR[d]
    permuted = covariance[np.ix_(order, order)] * np.outer(factor, factor)
    size = np.sqrt(np.clip(np.diag(permuted), 0.0, None))
    if not size.all():
        return None
    scaled = permuted / np.outer(size, size)
    low, *_, high = np.linalg.eigvalsh(scaled)
    if low <= _SINGULAR * high:
        return None
    return np.linalg.inv(scaled) / np.outer(size, size)


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)
