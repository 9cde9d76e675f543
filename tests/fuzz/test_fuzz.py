"""A slice of `make fuzz` in every test run, and proof that it can find wrong claims."""

import dataclasses

import numpy as np
import pytest

from dcreg.problem.geometry import fit_pose
from tests.fuzz import reference
from tests.fuzz.check import check, optimum
from tests.fuzz.problems import FAMILIES, KINDS, problem
from tests.oracles.kernels import k_assignment_brute_force
from tests.oracles.matchings import cheapest_fit

SLICES, PER_SLICE = 8, 15


@pytest.mark.parametrize("start", range(0, SLICES * PER_SLICE, PER_SLICE))
def test_no_claim_about_small_problems_is_wrong(start):
    wrong = {}
    for number in range(start, start + PER_SLICE):
        drawn = problem(number)
        verdict = check(drawn, drawn.solve())
        if verdict.faults:
            wrong[str(drawn)] = verdict.faults
    assert not wrong


def test_the_slice_has_every_family_and_kind():
    drawn = [problem(number) for number in range(SLICES * PER_SLICE)]
    assert {one.family for one in drawn} == set(FAMILIES)
    assert {one.kind for one in drawn} == set(KINDS)
    assert any(one.settings.get("bound") == "tight" for one in drawn)


@pytest.mark.parametrize("family", FAMILIES)
def test_planted_faults_are_found(family):
    drawn = next(
        one
        for one in (problem(number, family) for number in range(100))
        if one.kind == "general" and one.n_inliers > 2
    )
    result = drawn.solve()
    assert check(drawn, result).faults == []
    low, high, _ = optimum(drawn, result.gap_tol)
    above, below = high + 0.1 * result.gap_tol, low - 0.1 * result.gap_tol
    for change, words in (
        ({"lower_bound": above, "upper_bound": above}, "above the optimum"),
        ({"upper_bound": below, "lower_bound": below}, "below the optimum"),
        ({"upper_bound": high + 1.1 * result.gap_tol, "status": "optimal"}, "optimal within"),
        ({"objective": 0.9 * result.objective}, "stated"),
        ({"T_certified": 1.01 * result.T_certified * 2}, "T_certified: scale"),
    ):
        if "status" in change:
            change["status"] = type(result.status)(change["status"])
        faults = check(drawn, dataclasses.replace(result, **change)).faults
        assert any(words in fault for fault in faults), (change, faults)
    if result.certificate is not None:
        forged = dataclasses.replace(result.certificate, upper_bound=0.0)
        faults = check(drawn, dataclasses.replace(result, certificate=forged)).faults
        assert any("certificate refused" in fault for fault in faults), faults


def brute_force(source, target, allowed, k, scale_range):
    """The optimum by a pose fitted to every matching, with the library's least-squares fit."""

    def moved(x, y):
        T, d = fit_pose(x, y, scale_range), x.shape[1]
        return x @ T[:d, :d].T + T[:d, d]

    return cheapest_fit(source, target, k, moved, allowed)


@pytest.mark.parametrize("seed", range(20))
def test_reference_equals_fits_to_all_matchings(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(2, 5, 2)
    allowed = rng.random((n, m)) < 0.8
    allowed[np.arange(min(n, m)), np.arange(min(n, m))] = True
    k = int(rng.integers(1, min(n, m) + 1))
    for dim, scales in ((2, (0.5, 1.5)), (3, (1.0, 1.0))):
        x, y = rng.standard_normal((n, dim)), rng.standard_normal((m, dim))
        expected = brute_force(x, y, allowed, k, scales)
        found = reference.optimum(x, y, allowed, k, *scales)
        assert found == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_order_on_the_line_and_subsets_of_columns_agree(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 7, 2)
    k = int(rng.integers(1, min(n, m) + 1))
    x, norms = rng.standard_normal((n, 3)), np.sort(rng.random(m).round(1))
    everything = np.ones((n, m), dtype=bool)
    cost = (np.linalg.norm(x, axis=1)[:, None] - norms) ** 2
    expected = k_assignment_brute_force(cost, k)
    assert reference.cheapest_matching(cost, everything, k) == pytest.approx(expected)
    found = reference.norm_objective(x, norms, everything, k, np.zeros(3))
    assert found == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(5))
def test_enclosure_holds_what_a_dense_grid_finds(seed):
    rng = np.random.default_rng(seed)
    x, norms = rng.standard_normal((4, 3)), np.sort(2 * rng.random(4))
    everything = np.ones((4, 4), dtype=bool)
    lower, upper = reference.enclose_norm3d(x, norms, everything, 4, 0.05, 300_000)
    assert upper - lower <= 0.05 + 1e-12
    ticks = np.linspace(-3, 3, 31)
    grid = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
    values = [reference.norm_objective(x, norms, everything, 4, t) for t in grid]
    # a grid point lies within half a diagonal of the optimum, where the root moves by sqrt(k) of it
    reach = np.sqrt(4 * 3) * 0.1
    assert lower <= min(values)
    assert np.sqrt(min(values)) <= np.sqrt(upper) + reach
