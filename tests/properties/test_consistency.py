"""Feasible pairs that no pose can match: proofs from distances, against brute force."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dcreg
from dcreg.assignment import consistency
from dcreg.assignment.consistency import consistent, has_clique, refutes
from dcreg.driver.feasible import FEASIBLE
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget
from tests.oracles.matchings import cheapest_fit
from tests.problems import SEEDS
from tests.properties.test_candidates import feasible_problem

SCALES = {2: (0.5, 1.5), 3: (1.0, 1.0)}


def small(seed, dim):
    """Points that nearly fit for half of the seeds, and the minimum over all feasible matchings."""
    x, y, k, mask = feasible_problem(seed, dim)
    if seed % 2:
        both = min(len(x), len(y))
        y[:both] = x[:both] + 0.1 * np.random.default_rng(seed).standard_normal((both, dim))
    optimum = cheapest_fit(
        x, y, k, lambda a, b: apply_pose(fit_pose(a, b, SCALES[dim]), a), allowed=mask
    )
    return (x, y, mask, k, SCALES[dim]), optimum


@given(SEEDS, st.sampled_from([2, 3]), st.sampled_from([1.0 + 1e-6, 1.1, 3.0]))
def test_no_objective_that_a_pose_has_is_refuted(seed, dim, factor):
    problem, optimum = small(seed, dim)
    assert not refutes(*problem, factor * optimum + 1e-12, Budget())


def test_objectives_far_below_the_optimum_are_refuted():
    refuted = 0
    for seed in range(200):
        problem, optimum = small(seed, 3)
        refuted += optimum > 1e-9 and refutes(*problem, 0.01 * optimum, Budget())
    assert refuted > 10


@given(SEEDS, st.integers(1, 7), st.sampled_from([0.3, 0.6, 0.9]))
def test_cliques_are_found_where_there_are_any(seed, size, density):
    generator = np.random.default_rng(seed)
    upper = np.triu(generator.random((9, 9)) < density, 1)
    graph = (upper | upper.T).astype(np.float32)
    truth = any(
        graph[np.ix_(some, some)].sum() == size * (size - 1)
        for some in itertools.combinations(range(9), size)
    )
    assert has_clique(graph, size, iter(range(1, 10_000))) is truth


def test_an_undecided_search_is_no_refutation(monkeypatch):
    problem, optimum = next(
        (problem, optimum)
        for problem, optimum in (small(seed, 3) for seed in range(100))
        if refutes(*problem, 0.01 * optimum, Budget())
    )
    monkeypatch.setattr(consistency, "ATTEMPTS", ((0.6, 0),))
    assert not refutes(*problem, 0.01 * optimum, Budget())


def scattered(n_true, dim, n=40, several=3):
    """Random points with random feasible pairs; some of the target are moved source points."""
    generator = np.random.default_rng(n_true)
    x, y = generator.random((n, dim)), generator.random((n, dim))
    mask = np.zeros((n, n), dtype=bool)
    np.put_along_axis(mask, generator.integers(n, size=(n, several)), True, axis=1)
    y[:n_true] = x[:n_true, ::-1] * ([1.0] * (dim - 1) + [-1.0])
    y[:n_true] += 0.01 * generator.standard_normal((n_true, dim))
    mask[np.arange(n_true), np.arange(n_true)] = True
    return x, y, mask


SETTINGS = (
    {"model": "rigid3d"},
    {"model": "rigid3d", "pose_range": dcreg.PoseRange(max_angle=20.0)},
    {"model": "similarity2d", "scale_range": (0.9, 1.1)},
    {"model": "similarity3d", "scale_range": (0.9, 1.1)},
)


def registered(n_true, model, **settings):
    x, y, mask = scattered(n_true, 2 if model == "similarity2d" else 3)
    return dcreg.register(
        x, y, n_inliers=20, model=model, candidates=mask, max_rms=0.02, time_limit=10, **settings
    )


@pytest.mark.parametrize("settings", SETTINGS)
def test_a_registration_is_refuted_before_its_search(settings):
    found = registered(8, **settings)
    assert found.status == "refuted"
    assert [stage.name for stage in found.stages] == [FEASIBLE, "polish"]
    assert found.lower_bound == pytest.approx(20 * 0.02**2)
    assert found.objective > found.lower_bound > 20 * 0.02**2
    assert [event.status for event in found.trace] == ["refuted"]
    pose_range = settings.get("pose_range")
    if pose_range is not None:
        checked = pose_range.checked(scattered(8, 3)[0], (1.0, 1.0))
        assert checked.contains(found.T_target_source)


def test_a_registration_that_meets_the_residual_is_not_refuted():
    assert registered(20, model="rigid3d").reason == "a pose within max_rms was found"


def test_pairs_are_consistent_for_some_admissible_scale():
    source, target = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [0.0, 1.4]])
    pairs = np.array([[0, 0], [1, 1]])
    for scales, reach, near in (((1, 1), 0.39, 0), ((1, 1), 0.41, 1), ((0.5, 1.5), 0.0, 1)):
        assert consistent(source, target, pairs, scales, reach)[0, 1] == near
    assert not consistent(source, target, np.array([[0, 0], [0, 1]]), (0.5, 1.5), 9.0).any()
