"""With its default tolerances the library calls nothing optimal that it has hardly bounded."""

import numpy as np
import pytest

import dcreg
from baselines import registry
from baselines.contract import Instance, Limits
from data.registry import dataset
from dcreg.problem import exact_objective
from dcreg.status import Status
from tests.fuzz.problems import problem
from tests.golden.cases import CASES
from tests.problems import keywords
from workflows.disturb import make_instance

PROVEN = 0.98
TESTS = {"deformation": 0.03, "noise": 0.03, "mixed_outliers": 0.3, "occlusion_outliers": 0.3}


def assert_honest(found, source, target, n_pairs):
    """Check one result or solution; return whether it is certified without an exact fit."""
    lower, upper = found.lower_bound, found.upper_bound
    exact = upper <= exact_objective(source, target, n_pairs)
    if found.status is not Status.OPTIMAL:
        return False
    assert exact or lower >= PROVEN * upper
    return not exact


@pytest.mark.parametrize("mode", ["paper", "full"])
@pytest.mark.parametrize("name", CASES)
def test_golden_problems(name, mode):
    case = CASES[name]
    if mode not in dcreg.mode_names(case.model):
        pytest.skip("3D only")
    source, target = case.points()
    found = dcreg.register(
        source, target, **keywords(n_inliers=case.n_inliers, model=case.model, mode=mode)
    )
    assert assert_honest(found, source, target, case.n_inliers)


@pytest.mark.parametrize("test", TESTS)
@pytest.mark.parametrize("shape", ["fish", "glyph", "pony", "saurian"])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_problems_of_the_demo(shape, test, share):
    """Also where half of the pairs fit so well that the objective is tiny."""
    raw = make_instance(dataset("embedded"), shape, test, TESTS[test], 0, 24)
    model = dataset("embedded").model(shape)
    k = max(1, int(share * len(raw.pairs)))
    instance = Instance("demo", raw.source, raw.target, model, k, raw.scale_range, 0.1, 0)
    limits = Limits(60.0, nodes=4000)
    solution = registry.load("dcreg").solve(instance, limits)
    assert_honest(solution, raw.source, raw.target, k)
    assert solution.lower_bound <= solution.upper_bound


@pytest.mark.parametrize("number", range(60))
def test_random_problems(number):
    """Exact fits, duplicates and clutter among them, in units from 1e-3 to 1e3."""
    drawn = problem(number)
    settings = {k: v for k, v in drawn.settings.items() if k not in ("rel_gap", "abs_gap")}
    found = dcreg.register(
        drawn.source, drawn.target, n_inliers=drawn.n_inliers,
        candidates=None if drawn.allowed.all() else drawn.allowed, **keywords(**settings),
    )  # fmt: skip
    assert_honest(found, drawn.source, drawn.target, drawn.n_inliers)
    if found.is_exact:
        assert found.bound_ratio == 1.0


@pytest.mark.usefixtures("thin_slices")
@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
def test_thread_counts_do_not_change_the_result(model):
    rng = np.random.default_rng(0)
    dim = 2 if model == "similarity2d" else 3
    source = rng.standard_normal((16, dim))
    target = source[:14] + 0.05 * rng.standard_normal((14, dim))
    one, two = (
        dcreg.register(source, target, **keywords(n_inliers=12, model=model, threads=threads))
        for threads in (1, 2)
    )
    names = ("status", "lower_bound", "upper_bound", "n_nodes", "n_assignments")
    assert [getattr(one, name) for name in names] == [getattr(two, name) for name in names]


def test_matches_within_the_share():
    rng = np.random.default_rng(0)
    source = rng.standard_normal((60, 3))
    target = source + 0.01 * rng.standard_normal((60, 3))
    matches = np.column_stack([np.arange(60), np.r_[np.arange(40), rng.permutation(20) + 40]])
    found = dcreg.register_matches(source, target, matches, inlier_distance=0.1)
    assert found.status is Status.OPTIMAL
    assert found.lower_bound >= PROVEN * found.upper_bound > 0.0


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
def test_invalid_points_far_away_certify_nothing(model):
    """Map coordinates, half of the points overlap, and each cloud has a point at the origin."""
    dim = 2 if model == "similarity2d" else 3
    rng = np.random.default_rng(3)
    place = np.array([5e5, 5.4e6, 300.0])[:dim]
    points = rng.random((90, dim))
    source, target = points[:60], points[30:] + 0.01 * rng.standard_normal((60, dim))
    clouds = [np.vstack([cloud + place, np.zeros((1, dim))]) for cloud in (source, target)]
    found = dcreg.register(*clouds, n_inliers=20, model=model, time_limit=5.0)
    assert not found.is_exact
    assert found.status is not Status.OPTIMAL or found.lower_bound >= PROVEN * found.upper_bound
    lines = list(dcreg.advice(dcreg.Problem(*clouds, 20, model)))
    assert [name for name in ("source", "target") if f"warning: {name}: some points" in str(lines)]
