"""Features of a problem that may predict the effort of a proof."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from data.library.problem import Problem
from data.library.record import Record
from dcreg.problem import median_spacing

MIN_ANGLE_DEG = 40.0  # smaller rotations do not count as another orientation
TURNS_2D = 120
TURNS_3D = 600


@dataclass(frozen=True)
class Features:
    """What may predict the effort of a proof.

    Attributes
    ----------
    n_points : float
        Geometric mean of the sizes of both clouds.
    pair_share : float
        `n_inliers` as a share of the smaller cloud.
    overlap : float
        True pairs as a share of the larger cloud.
    residual : float
        RMS residual at the best pose, in median spacings of the target.
    asymmetry : float
        Minimum over rotations of at least 40 degrees of the RMS distance from the rotated source to its
        nearest source points, in median spacings of the source. 0: the source has a symmetry.
    """

    n_points: float
    pair_share: float
    overlap: float
    residual: float
    asymmetry: float


def features_of(problem: Problem, record: Record) -> Features:
    """Return the features of a problem with a known pose."""
    source, target = problem.clouds
    sizes = len(source), len(target)
    rms = np.sqrt(record.objective / problem.n_inliers)
    return Features(
        n_points=float(np.sqrt(sizes[0] * sizes[1])),
        pair_share=problem.n_inliers / min(sizes),
        overlap=problem.overlap,
        residual=float(rms / median_spacing(target)),
        asymmetry=asymmetry(source),
    )


def asymmetry(points: np.ndarray) -> float:
    """Return how far the cloud is from a rotated copy of itself, in median spacings."""
    centred = points - points.mean(axis=0)
    moved = np.einsum("rij,pj->rpi", _turns(points.shape[1]), centred)
    distance, _ = cKDTree(centred).query(moved.reshape(-1, points.shape[1]))
    rms = np.sqrt((distance.reshape(len(moved), -1) ** 2).mean(axis=1))
    return float(rms.min() / median_spacing(points))


def _turns(dim: int) -> np.ndarray:
    """Return rotations of at least `MIN_ANGLE_DEG`, the same in every call."""
    if dim == 2:
        angles = np.linspace(0.0, 2 * np.pi, TURNS_2D, endpoint=False)
        away = np.abs((angles + np.pi) % (2 * np.pi) - np.pi) >= np.radians(MIN_ANGLE_DEG)
        angles = angles[away]
        return np.stack(
            [[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]]
        ).transpose(2, 0, 1)
    turns = Rotation.random(TURNS_3D, random_state=0)
    return turns[turns.magnitude() >= np.radians(MIN_ANGLE_DEG)].as_matrix()
