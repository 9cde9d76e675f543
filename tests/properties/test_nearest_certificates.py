"""Go-ICP, FRS and GoTS never certify a wrong optimum, judged by exhaustive references.

The suite takes a few problems; the full run is ``CERTIFICATES=1000 CERTIFICATE_SECONDS=20 pytest`` of
this file. A search stopped at its limit must still have a valid lower bound.
"""

from __future__ import annotations

import itertools
import os

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines.contract import Instance, Limits
from baselines.gots.search import points_of
from dcreg.problem import apply_pose
from dcreg.status import Status
from tests.oracles.matchings import rotation_residuals
from tests.searches import is_certified

COUNT = int(os.environ.get("CERTIFICATES", "6"))
LIMITS = Limits(time_s=float(os.environ.get("CERTIFICATE_SECONDS", "3")))


def small_instance(seed: int, n: int, m: int, noise: float) -> Instance:
    """Every third problem is planted, every third partly, every third is of unrelated clouds."""
    generator = np.random.default_rng([seed, n, m])
    source = generator.uniform(-0.5, 0.5, (n, 3))
    target = generator.uniform(-0.5, 0.5, (m, 3))
    shared = (min(n, m), 3, 0)[seed % 3]
    rotation = Rotation.random(random_state=generator).as_matrix()
    target[:shared] = source[:shared] @ rotation.T
    target[:shared] += noise * generator.standard_normal((shared, 3)) / np.sqrt(3)
    target += generator.uniform(-1, 1, 3)
    n_inliers = int(generator.integers(3, min(n, m) + 1))
    return Instance(f"small-{seed}", source, target, "rigid3d", n_inliers, (1, 1), noise, seed)


def maps(n: int, m: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """All choices of `size` source points (rows) with all their partners (columns)."""
    rows = np.array(list(itertools.combinations(range(n), size)))
    columns = np.array(list(itertools.product(range(m), repeat=size)))
    return np.repeat(rows, len(columns), axis=0), np.tile(columns, (len(rows), 1))


def least_squares(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Minimum sums of squared residuals over rigid poses of paired points (b, k, 3)."""
    x = source - source.mean(axis=1, keepdims=True)
    y = target - target.mean(axis=1, keepdims=True)
    return np.maximum(rotation_residuals(x, y), 0.0)


def distances_to(target: np.ndarray, pose: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Distance of each moved source point to its nearest target point."""
    moved = apply_pose(pose, source)
    return np.linalg.norm(moved[:, None] - target, axis=2).min(axis=1)


@pytest.mark.parametrize("seed", range(COUNT))
def test_goicp(seed: int) -> None:
    instance = small_instance(seed, 5, 4, 0.02)
    rows, columns = maps(5, 4, instance.n_inliers)
    best = least_squares(instance.source[rows], instance.target[columns]).min()
    solution = registry.load("goicp", mse_threshold=0.02, start_rotations=1).solve(instance, LIMITS)
    assert is_certified(solution, best, solution.gap_tol) or solution.status is Status.TIME_LIMIT
    distances = distances_to(instance.target, solution.T_target_source, instance.source)
    value = (np.sort(distances)[: instance.n_inliers] ** 2).sum()
    assert value == pytest.approx(solution.upper_bound, abs=1e-9)


def minimax(source: np.ndarray, target: np.ndarray) -> float:
    """Upper bound on the minimax residual of a rigid fit, by Lawson's reweighting."""
    weights, smallest = np.full(len(source), 1.0 / len(source)), np.inf
    for _ in range(300):
        x, y = source - weights @ source, target - weights @ target
        rotation, _ = Rotation.align_vectors(y, x, weights=weights + 1e-15)
        residuals = np.linalg.norm(y - rotation.apply(x), axis=1)
        smallest = min(smallest, float(residuals.max()))
        weights *= residuals + 1e-15
        weights /= weights.sum()
    return smallest


def attainable(instance: Instance, size: int, radius: float) -> bool:
    """Whether some pose is known to bring `size` source points within the radius of the target."""
    x, y = instance.source, instance.target
    rows, columns = maps(len(x), len(y), size)
    inside = np.linalg.norm(x[:, None] - x, axis=2)
    outside = np.linalg.norm(y[:, None] - y, axis=2)
    for a, b in itertools.combinations(range(size), 2):
        differ = inside[rows[:, a], rows[:, b]] - outside[columns[:, a], columns[:, b]]
        near = np.abs(differ) <= 2 * radius
        rows, columns = rows[near], columns[near]
    near = least_squares(x[rows], y[columns]) <= size * radius**2
    pairs = zip(rows[near], columns[near], strict=True)
    return any(minimax(x[row], y[column]) <= radius * (1 - 1e-6) for row, column in pairs)


@pytest.mark.parametrize("seed", range(COUNT))
def test_frs(seed: int) -> None:
    instance = small_instance(seed, 5, 5, 0.03)
    method = registry.load("frs", noise_factor=1.5, polish=False)
    solution = method.solve(instance, LIMITS)
    radius = 1.5 * instance.noise_bound
    most = instance.n_inliers - solution.lower_bound / radius**2
    matched = instance.n_inliers - solution.upper_bound / radius**2
    distances = distances_to(instance.target, solution.T_target_source, instance.source)
    assert (distances <= radius + 1e-9).sum() >= round(matched)
    above = int(np.floor(most + 1e-6)) + 1
    if above <= len(instance.source):
        assert not attainable(instance, above, radius)
    if solution.status is Status.OPTIMAL:
        assert most == pytest.approx(matched)
    else:
        assert solution.status is Status.TIME_LIMIT


def crossings(instance: Instance, eps: float, generator: np.random.Generator) -> np.ndarray:
    """Translations that give three source points the norms of target points, up to eps."""
    x = instance.source - instance.source.mean(axis=0)
    norms = np.linalg.norm(instance.target - instance.target.mean(axis=0), axis=1)
    found = []
    for rows in itertools.combinations(range(len(x)), 3):
        p = x[list(rows)]
        radii = norms[np.array(list(itertools.product(range(len(norms)), repeat=3)))]
        radii = np.vstack([radii, radii + eps * generator.uniform(-1, 1, radii.shape)])
        # |p_a + t|^2 = r_a^2; differences are linear in t, the rest is a line meeting a sphere.
        matrix = 2 * (p[1:] - p[0])
        right = (radii[:, 1:] ** 2 - radii[:, :1] ** 2) - ((p[1:] ** 2).sum(1) - p[0] @ p[0])
        base = right @ np.linalg.pinv(matrix).T
        axis = np.cross(matrix[0], matrix[1])
        axis /= np.linalg.norm(axis)
        half = (base + p[0]) @ axis
        rest = ((base + p[0]) ** 2).sum(axis=1) - radii[:, 0] ** 2
        root = np.sqrt(np.maximum(half**2 - rest, 0.0))
        found += [base + (-half + sign * root)[:, None] * axis for sign in (-1, 1)]
    return np.vstack(found)


def pair_counts(instance: Instance, ts: np.ndarray, eps: float) -> np.ndarray:
    """Matched source pairs at each translation, by the definition."""
    x = instance.source - instance.source.mean(axis=0)
    y = instance.target - instance.target.mean(axis=0)
    norms = np.linalg.norm(x + ts[:, None], axis=2)
    near = np.abs(norms[:, :, None] - np.linalg.norm(y, axis=1)) <= eps
    lengths = np.linalg.norm(y[:, None] - y, axis=2)
    counts = np.zeros(len(ts), dtype=int)
    for i, k in itertools.combinations(range(len(x)), 2):
        same = np.abs(lengths - np.linalg.norm(x[i] - x[k])) <= 2 * eps
        np.fill_diagonal(same, False)
        counts += np.einsum("tj,jl,tl->t", near[:, i], same, near[:, k], optimize=True) > 0
    return counts


@pytest.mark.parametrize("seed", range(COUNT))
def test_gots(seed: int) -> None:
    instance = small_instance(seed, 6, 6, 0.03)
    solution = registry.load("gots", noise_factor=1.0).solve(instance, LIMITS)
    eps = instance.noise_bound
    generator = np.random.default_rng(seed)
    candidates = crossings(instance, eps * (1 - 1e-9), generator)
    candidates = np.vstack([candidates, generator.uniform(-1.5, 1.5, (2000, 3))])
    counts = pair_counts(instance, candidates, eps * (1 - 1e-9))
    # Ascent of the reference: translations near its best ones.
    best = candidates[np.argsort(-counts, kind="stable")[:50]]
    close = (best[:, None] + eps * generator.uniform(-1, 1, (50, 40, 3))).reshape(-1, 3)
    known = max(counts.max(), pair_counts(instance, close, eps * (1 - 1e-9)).max())
    assert solution.lower_bound <= eps**2 * (instance.n_inliers - points_of(known)) + 1e-12
    matched = solution.extra["matched_pairs"]
    assert solution.upper_bound == pytest.approx(
        eps**2 * (instance.n_inliers - points_of(matched)), abs=1e-12
    )
    if solution.status is Status.OPTIMAL:
        assert matched >= known
    else:
        assert solution.status is Status.TIME_LIMIT
