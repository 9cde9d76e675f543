"""Problems: what they hold, and bad input, which is refused before anything is searched."""

import numpy as np
import pytest

import dcreg
from dcreg.problem import Problem, exact_objective, rounding_error
from dcreg.problem.geometry import EXACT
from tests.problems import register

GOOD = np.random.default_rng(0).random((6, 2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale_range": 3}, "scale_range: 3 is not a pair"),
        ({"tol": "small"}, "tol: 'small'.*give a length"),
        ({"threads": 2.5}, r"threads: 2\.5 is not a whole number"),
        ({"node_limit": 2.5}, r"node_limit: 2\.5 is not a whole number; give one such as"),
        ({"memory_limit_mb": 0}, "memory_limit_mb: 0 .*give a positive number"),
        ({"polish": "no"}, "polish: 'no' is not a bool; give True or False"),
        ({"certificate": 1}, "certificate: 1 is not a bool"),
        ({"listener": 3}, "listener: 3 cannot be called; give a function"),
        ({"bound": 3}, "bound: 3 is unknown"),
        ({"mode": ""}, "mode: '' is unknown"),
    ],
)
def test_bad_input_is_named(change, message):
    """More of it is in `tests.bad_input`."""
    with pytest.raises(dcreg.InputError, match=message):
        register(GOOD, GOOD, n_inliers=6, model="similarity2d", **change)


@pytest.mark.parametrize("options", [{"mode": "paper"}, {}, "paper", dcreg.SolveOptions])
@pytest.mark.parametrize("solve", ["register", "sweep", "register_matches"])
def test_options_of_another_type_are_refused(solve, options):
    points, rows = np.random.default_rng(0).random((5, 3)), np.arange(5)
    given = {
        "register": {"n_inliers": 5, "model": "rigid3d"},
        "sweep": {"n_inliers": [4, 5], "model": "rigid3d"},
        "register_matches": {"matches": np.column_stack([rows, rows]), "inlier_distance": 0.1},
    }
    with pytest.raises(dcreg.InputError, match=r"options: .*SolveOptions"):
        getattr(dcreg, solve)(points, points, **given[solve], options=options)


def test_unknown_bound_is_refused_by_modes_with_bounds_of_their_own():
    points = np.random.default_rng(0).random((5, 3))
    with pytest.raises(dcreg.InputError, match="bound: 'papr' is unknown"):
        register(points, points, n_inliers=5, model="rigid3d", mode="full", bound="papr")


@pytest.mark.parametrize(
    ("given", "expected"), [(3, 3), (0.5, 3), (1.0, 6), (0.29, 1), (np.int64(4), 4), (1e-9, 1)]
)
def test_n_inliers_is_a_count_or_a_fraction(given, expected):
    assert Problem(GOOD, GOOD, given, "similarity2d").n_inliers == expected


def test_fraction_does_not_lose_a_pair_to_rounding():
    points = np.random.default_rng(0).random((100, 2))
    assert Problem(points, points, 0.29, "similarity2d").n_inliers == 29


def test_problem_copies_its_input():
    points = GOOD.copy()
    problem = Problem(points, points, 3, "similarity2d")
    points[:] = 0
    assert (problem.source != 0).all()


def test_rounding_error_scales_with_the_square_of_the_target():
    source = np.zeros((5, 2))
    rounding = rounding_error(source, GOOD, 4)
    assert rounding_error(source, 3 * GOOD, 4) == pytest.approx(9 * rounding)
    radius = np.sqrt(((GOOD - GOOD.mean(0)) ** 2).sum(1).mean())
    assert rounding == pytest.approx(4 * (1e-7 * radius) ** 2)


def test_a_far_point_does_not_make_a_fit_exact():
    points = np.random.default_rng(0).standard_normal((50, 3))
    near = exact_objective(points, points, 30)
    assert near == pytest.approx(EXACT * rounding_error(points, points, 30))
    far = np.vstack([points, np.full((1, 3), 1e6)])
    assert exact_objective(far, far, 30) < 30 * near
    assert rounding_error(far, far, 30) > near
    assert exact_objective(far[:1], np.zeros((4, 3)), 1) > 0.0  # without extent


def test_rounding_error_far_from_the_origin_is_that_of_the_coordinates():
    near, far = (rounding_error(GOOD + shift, GOOD + shift, 4) for shift in (0.0, 1e12))
    assert far > 100 * near
