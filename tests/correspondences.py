"""Planted correspondences, for the tests of methods that are given them."""

import numpy as np
from scipy.spatial.transform import Rotation

from baselines._shared.poses import homogeneous
from baselines.contract import Instance
from dcreg.problem import apply_pose

NOISE = 0.01


def planted(
    model: str, n: int, outlier_share: float, unit: float = 1.0
) -> tuple[Instance, np.ndarray]:
    """Row i of the source corresponds to row i of the target, except the first rows."""
    generator = np.random.default_rng(3)
    dim = 2 if model == "similarity2d" else 3
    source = generator.uniform(-0.5, 0.5, (n, dim))
    if dim == 2:
        turn, scale, scale_range = Rotation.from_rotvec([0, 0, 2.1]).as_matrix(), 0.7, (0.5, 1.5)
    else:
        turn, scale, scale_range = Rotation.from_rotvec([1.1, -0.7, 1.9]).as_matrix(), 1.0, (1, 1)
    truth = homogeneous(scale, turn[:dim, :dim], np.array([5.0, -3.0, 2.0])[:dim])
    jitter = generator.standard_normal((n, dim))
    jitter /= np.maximum(1.0, np.linalg.norm(jitter, axis=1, keepdims=True))
    target = apply_pose(truth, source) + 0.6 * NOISE * jitter
    wrong = round(outlier_share * n)
    target[:wrong] = target.mean(axis=0) + generator.uniform(-0.5, 0.5, (wrong, dim))
    truth[:dim, dim] *= unit
    clouds = unit * source, unit * target
    return Instance("planted", *clouds, model, n - wrong, scale_range, unit * NOISE, 5), truth


def rows_as_pairs(n: int) -> np.ndarray:
    return np.column_stack([np.arange(n), np.arange(n)])
