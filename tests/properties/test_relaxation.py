"""The relaxation over feasible pairs: no bound exceeds the objective, and no answer is wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dcreg
from dcreg.driver.modes import FEASIBLE
from dcreg.families.matches.problem import MatchProblem
from dcreg.families.matches.relaxation import RelaxedBound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.search import Box, Boxes, Tolerance
from tests.oracles.matchings import cheapest_fit
from tests.problems import SEEDS
from tests.properties.test_candidates import feasible_problem, minimum_cost


@given(SEEDS, st.sampled_from([0.01, 0.3, 3.0]), st.sampled_from([1.0, 0.2, 0.02]))
def test_no_pose_of_a_box_has_an_objective_below_its_bound(seed, limit, half):
    x, y, k, mask = feasible_problem(seed, 3)
    problem = MatchProblem(x, y, np.argwhere(mask), float(np.sqrt(3.0 * limit / k)))
    bound, generator = (
        RelaxedBound(problem, k, Tolerance(target=limit)),
        np.random.default_rng(seed),
    )
    centre = generator.standard_normal(4)
    box = Box(centre - half, centre + half)
    # a box that may contain a pose with an objective of at most the limit must not be pruned
    lower = bound.evaluate(Boxes.of([box]), Tolerance(target=limit).cutoff(np.inf)).lower_bounds[0]
    for theta in box.sample(generator, 20):
        moved = x @ Rotation3D.matrix(theta).T
        i, j = np.argwhere(mask)[generator.integers(mask.sum())]
        value = minimum_cost(moved + y[j] - moved[i], y, mask, k)
        assert min(lower, limit * (1 + 1e-9)) <= value + 1e-9


def small(seed):
    """Points that nearly fit for some seeds, with the minimum over all feasible matchings."""
    x, y, k, mask = feasible_problem(seed, 3)
    if seed % 2:
        both = min(len(x), len(y))
        y[:both] = x[:both] + 0.1 * np.random.default_rng(seed).standard_normal((both, 3))
    return x, y, k, mask, cheapest_fit(
        x, y, k, lambda a, b: apply_pose(fit_pose(a, b, (1.0, 1.0)), a), allowed=mask
    )  # fmt: skip


@given(SEEDS, st.sampled_from([0.3, 0.9, 1.01, 2.0]))
def test_answers_agree_with_all_matchings(seed, factor):
    x, y, k, mask, optimum = small(seed)
    limit = factor * (optimum + 1e-6)
    found = dcreg.register(
        x, y, n_inliers=k, model="rigid3d", candidates=mask, max_rms=float(np.sqrt(limit / k)),
        time_limit=1.0,
    )  # fmt: skip
    assert found.lower_bound <= optimum + 1e-9
    assert found.status != "refuted" or optimum > limit * (1 - 1e-9)
    if found.reason == "a pose within max_rms was found":
        assert optimum <= limit * (1 + 1e-9)


def scattered(n_true, seed=0, n=60, several=5):
    """Points of two unit cubes with random feasible pairs; some of the target are moved source points."""
    generator = np.random.default_rng(seed)
    x, y = generator.random((n, 3)), generator.random((n, 3))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation3D.matrix(generator.standard_normal(4)), generator.random(3)
    mask = np.zeros((n, n), dtype=bool)
    np.put_along_axis(mask, generator.integers(n, size=(n, several)), True, axis=1)
    y[:n_true] = apply_pose(T, x[:n_true]) + 0.01 * generator.standard_normal((n_true, 3))
    mask[np.arange(n_true), np.arange(n_true)] = True
    return x, y, mask


@pytest.mark.parametrize("n_true", [0, 12, 20])
def test_matches_are_refuted_by_boxes_of_rotations(n_true):
    x, y, mask = scattered(n_true)
    found = dcreg.register(
        x, y, n_inliers=20, model="rigid3d", candidates=mask, max_rms=0.03, time_limit=20
    )
    assert found.stages[0].name == FEASIBLE
    if n_true < 20:
        assert found.status == "refuted"
        assert [stage.name for stage in found.stages] == [FEASIBLE, "polish"]
        assert found.lower_bound > 20 * 0.03**2
        assert found.objective > 20 * 0.03**2
    else:
        assert found.reason == "a pose within max_rms was found"
    lower = [event.lower_bound for event in found.trace]
    assert lower == sorted(lower)
    assert all(event.upper_bound >= found.lower_bound for event in found.trace)
