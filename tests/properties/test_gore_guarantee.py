"""GORE's guarantee: what can be in a largest consensus set is never removed."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from baselines.gore.removal import _arc, _rotation_reach, remove_outliers


@st.composite
def problems(draw: st.DrawFn) -> tuple:
    """Planted inliers within the bound of a random pose, among random correspondences."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(8, 60))
    n_inliers = draw(st.integers(max(4, n // 5), n))
    bound = draw(st.sampled_from([1e-6, 0.01, 0.03, 0.1]))
    flat = draw(st.sampled_from([1.0, 0.05, 0.0]))
    source = generator.uniform(-0.5, 0.5, (n, 3)) * [1.0, 1.0, flat]
    if draw(st.booleans()):
        source[1] = source[0]  # one point in two correspondences
    rotation = Rotation.random(random_state=generator).as_matrix()
    offset = generator.standard_normal((n, 3))
    offset *= bound * 0.999 / np.linalg.norm(offset, axis=1, keepdims=True)
    offset *= generator.choice([1.0, 0.5, 0.0], (n, 1))  # many just within the bound
    target = source @ rotation.T + offset + generator.standard_normal(3)
    target[n_inliers:] = target.mean(axis=0) + generator.uniform(-0.5, 0.5, (n - n_inliers, 3))
    return source, target, bound, n_inliers, rotation


@given(problems())
@settings(max_examples=150, deadline=None)
def test_no_planted_inlier_is_ever_removed(problem: tuple) -> None:
    source, target, bound, n_inliers, _ = problem
    removal = remove_outliers(source, target, bound)
    assert removal.finished
    # The promise is to largest consensus sets; the planted one is no such set if a larger is known.
    if removal.consensus <= n_inliers:
        assert set(range(n_inliers)) <= set(removal.kept)
    assert len(removal.kept) >= removal.consensus


@given(problems())
@settings(max_examples=100, deadline=None)
def test_reach_is_no_less_than_the_planted_consensus(problem: tuple) -> None:
    source, target, bound, n_inliers, _ = problem
    for k in range(0, n_inliers, 5):
        others = np.delete(np.arange(len(source)), k)
        reach, rotation = _rotation_reach(
            source[others] - source[k], target[others] - target[k], 2 * bound, 0
        )
        assert reach >= n_inliers - 1
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(0.001, 3.2))
@settings(max_examples=300, deadline=None)
def test_arcs_hold_exactly_the_angles_that_come_near(seed: int, reach: float) -> None:
    generator = np.random.default_rng(seed)
    axis, x, y = generator.standard_normal((3, 3))
    axis, x, y = (v / np.linalg.norm(v) for v in (axis, x, y))
    centre, half = _arc(x, y, axis, reach)
    angles = np.linspace(-np.pi, np.pi, 361)
    moved = Rotation.from_rotvec(angles[:, None] * axis).apply(x)
    near = moved @ y >= np.cos(min(reach, np.pi))
    away = np.abs((angles - centre + np.pi) % (2 * np.pi) - np.pi)
    assert not (near & (away > half)).any()
    assert not (~near & (away < half - 1e-6)).any()


def test_most_outliers_go() -> None:
    """The guarantee would be kept by removing nothing."""
    generator = np.random.default_rng(0)
    source = generator.uniform(-0.5, 0.5, (200, 3))
    target = source + 0.003
    target[40:] = generator.uniform(-0.5, 0.5, (160, 3))
    removal = remove_outliers(source, target, 0.01)
    assert removal.consensus >= 40
    assert len(removal.kept) <= 45
    assert set(range(40)) <= set(removal.kept)
