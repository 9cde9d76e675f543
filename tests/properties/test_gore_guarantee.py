"""GORE's guarantee: members of a maximum consensus set are never removed."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from baselines._shared.cubes import OutOfTimeError
from baselines._shared.robust import refit, squared_residuals
from baselines._shared.rotation_search import Found, most_correspondences
from baselines.gore import removal as gore
from baselines.gore.kernels import arc
from baselines.gore.removal import _Removing, _rotation_reach, remove_outliers
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget
from tests.problems import SEEDS


@st.composite
def problems(draw: st.DrawFn) -> tuple:
    """Planted inliers within the bound of a random pose, among random correspondences."""
    generator = np.random.default_rng(draw(SEEDS))
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


def sparse(seed: int, n: int = 60, n_inliers: int = 6, bound: float = 0.05) -> tuple:
    """Few inliers under a wide bound: problems that intervals of angles do not complete."""
    generator = np.random.default_rng(seed)
    source = generator.uniform(-0.5, 0.5, (n, 3))
    offset = generator.standard_normal((n, 3))
    offset *= bound * generator.random((n, 1)) / np.linalg.norm(offset, axis=1, keepdims=True)
    target = Rotation.random(random_state=generator).apply(source) + offset
    target[n_inliers:] = target.mean(axis=0) + generator.uniform(-0.5, 0.5, (n - n_inliers, 3))
    return source, target, bound, n_inliers


def loses_inliers(problem: tuple) -> bool:
    """Return whether the guarantee is violated for the planted set, if no larger set is known."""
    source, target, bound, n_inliers = problem
    removal = remove_outliers(source, target, bound, Budget())
    return removal.consensus <= n_inliers and not set(range(n_inliers)) <= set(removal.kept)


def loses_a_set_of_triples(removal, source, target, bound: float, seed: int) -> bool:
    """Return whether a set as large as the best of 300 fits to random triples lost a member."""
    generator, n = np.random.default_rng(seed), len(source)
    for _ in range(300):
        weights = np.zeros(n)
        weights[generator.choice(n, 3, replace=False)] = 1.0
        pose = refit(fit_pose(source, target, (1.0, 1.0), weights), source, target, bound)
        members = np.flatnonzero(squared_residuals(pose, source, target) <= bound**2)
        if len(members) >= removal.consensus and not set(members) <= set(removal.kept):
            return True
    return False


@given(problems())
@settings(max_examples=150, deadline=None)
def test_no_planted_inlier_is_ever_removed(problem: tuple) -> None:
    source, target, bound, n_inliers, _ = problem
    removal = remove_outliers(source, target, bound, Budget())
    assert removal.finished
    # The guarantee concerns maximum consensus sets, not the planted one if a larger is known.
    if removal.consensus <= n_inliers:
        assert set(range(n_inliers)) <= set(removal.kept)
    assert len(removal.kept) >= removal.consensus


def test_only_correspondences_that_agree_with_one_another_are_counted() -> None:
    generator = np.random.default_rng(0)
    x = generator.uniform(0.5, 1.0, (12, 3))
    y = Rotation.from_rotvec([0.3, -1.0, 0.4]).apply(x)
    linked = np.zeros((12, 12), dtype=bool)
    linked[:5, :5] = linked[5:, 5:] = True
    assert _rotation_reach(x, y, 0.01, 0, Budget())[0] == 12
    assert _rotation_reach(x, y, 0.01, 0, Budget(), linked)[0] == 7
    assert _rotation_reach(x, y, 0.01, 8, Budget(), linked)[0] == 0


@given(SEEDS, st.floats(0.001, 3.2))
@settings(max_examples=300, deadline=None)
def test_arcs_hold_exactly_the_angles_that_come_near(seed: int, reach: float) -> None:
    generator = np.random.default_rng(seed)
    axis, x, y = generator.standard_normal((3, 3))
    axis, x, y = (v / np.linalg.norm(v) for v in (axis, x, y))
    centre, half = arc(x, y, axis, reach)
    angles = np.linspace(-np.pi, np.pi, 361)
    moved = Rotation.from_rotvec(angles[:, None] * axis).apply(x)
    near = moved @ y >= np.cos(min(reach, np.pi))
    away = np.abs((angles - centre + np.pi) % (2 * np.pi) - np.pi)
    assert not (near & (away > half)).any()
    assert not (~near & (away < half - 1e-6)).any()


def test_most_outliers_go() -> None:
    """The guarantee also holds if nothing is removed."""
    generator = np.random.default_rng(0)
    source = generator.uniform(-0.5, 0.5, (200, 3))
    target = source + 0.003
    target[40:] = generator.uniform(-0.5, 0.5, (160, 3))
    removal = remove_outliers(source, target, 0.01, Budget())
    assert removal.consensus >= 40
    assert len(removal.kept) <= 45
    assert set(range(40)) <= set(removal.kept)


@given(SEEDS, st.sampled_from([0.03, 0.05, 0.1, 0.2]))
@settings(max_examples=30, deadline=None)
def test_no_set_as_large_as_the_best_known_loses_a_member(seed: int, bound: float) -> None:
    """Planted or not: sets from fits to random triples, those of chance included."""
    source, target, _, _ = sparse(seed, 30, 5, bound)
    removal = remove_outliers(source, target, bound, Budget())
    assert not loses_a_set_of_triples(removal, source, target, bound, seed)


@given(problems(), st.booleans())
@settings(max_examples=80, deadline=None)
def test_both_reaches_are_no_less_than_the_planted_consensus(problem: tuple, cut: bool) -> None:
    source, target, bound, n_inliers, _ = problem
    state = _Removing(source, target, bound, Budget())
    if cut:  # as if the planted set were known: with it the search ends earliest
        state.most = n_inliers
    for k in range(0, n_inliers, 5):
        others = np.flatnonzero(state.graph[k])
        assert set(range(n_inliers)) <= {*others, k}
        searched = state.search(k, others)
        assert searched[0] <= len(others)
        x, y = np.delete(source - source[k], k, axis=0), np.delete(target - target[k], k, axis=0)
        for reach, rotation in (searched, _rotation_reach(x, y, 2 * bound, 0, Budget())):
            assert reach >= n_inliers - 1
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_search_removes_and_finds_what_intervals_do_not() -> None:
    tighter = larger = 0
    for seed in range(20):
        source, target, bound, _ = sparse(seed, 80, 6, 0.07)
        arcs = remove_outliers(source, target, bound, Budget(), rotation_search=False)
        both = remove_outliers(source, target, bound, Budget())
        assert both.consensus >= arcs.consensus
        assert set(both.kept) <= set(arcs.kept) or both.consensus > arcs.consensus
        larger += both.consensus > arcs.consensus
        tighter += both.consensus == arcs.consensus and len(both.kept) < len(arcs.kept)
    assert larger >= 3
    assert tighter >= 3  # no larger set is known: the tighter bound alone did it


def half_the_tolerance(x, y, radius, *rest) -> Found:
    return most_correspondences(x, y, radius / 2, *rest)


def one_too_few(*args) -> Found:
    found = most_correspondences(*args)
    return replace(found, upper_bound=found.upper_bound - 1)


@pytest.mark.parametrize("wrong", [half_the_tolerance, one_too_few])
def test_a_wrong_bound_in_the_search_would_lose_inliers(
    wrong, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tests of the guarantee can fail on these problems."""
    problems = [sparse(seed) for seed in range(30)]
    assert not any(loses_inliers(problem) for problem in problems)
    monkeypatch.setattr(gore, "most_correspondences", wrong)
    assert any(loses_inliers(problem) for problem in problems)


def test_search_out_of_time_leaves_what_intervals_left(monkeypatch: pytest.MonkeyPatch) -> None:
    def late(*_: object) -> Found:
        raise OutOfTimeError

    source, target, bound, _ = sparse(2)
    arcs = remove_outliers(source, target, bound, Budget(), rotation_search=False)
    monkeypatch.setattr(gore, "most_correspondences", late)
    cut = remove_outliers(source, target, bound, Budget())
    assert arcs.finished
    assert not cut.finished
    np.testing.assert_array_equal(cut.kept, arcs.kept)


@pytest.mark.parametrize(("n", "bound", "limit"), [(3000, 0.12, 0.5), (200, 0.15, 1.6)])
def test_time_limit_holds(n: int, bound: float, limit: float, processor_clock: None) -> None:
    """During the intervals of one correspondence of thousands, and during the search."""
    remove_outliers(*sparse(0)[:3], Budget())  # compiled
    source, target, _, _ = sparse(0, n, 6, bound)
    start = time.process_time()
    removal = remove_outliers(source, target, bound, Budget(limit))
    assert time.process_time() - start < 2.5 * limit  # one slice and a refit
    assert len(removal.kept) > 0
