"""Bad input is refused with field, value and remedy before anything is searched."""

import numpy as np
import pytest

import dcreg
from dcreg.problem import Problem, default_gap_tol
from tests.problems import register

GOOD = np.random.default_rng(0).random((6, 2))


def with_value(value):
    points = GOOD.copy()
    points[2, 1] = value
    return points


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"source": with_value(np.nan)}, r"source: 1 point.*row 2.*remove"),
        ({"target": with_value(np.inf)}, r"target: 1 point.*row 2.*remove"),
        ({"source": np.empty((0, 2))}, r"source: no points"),
        ({"source": np.zeros((4, 3))}, r"source: shape \(4, 3\).*needs \(n, 2\)"),
        ({"target": np.zeros(4)}, r"target: shape \(4,\)"),
        ({"source": [["a", "b"]]}, r"source: not an array of numbers"),
        ({"model": "affine"}, r"model: 'affine' is unknown.*similarity2d"),
        ({"n_inliers": 0}, r"n_inliers: 0 pairs.*between 1 and 6"),
        ({"n_inliers": 7}, r"n_inliers: 7 pairs.*between 1 and 6"),
        ({"n_inliers": 1.5}, r"n_inliers: the fraction 1.5 is outside"),
        ({"n_inliers": "many"}, r"n_inliers: 'many' is not a number"),
        ({"n_inliers": True}, r"n_inliers: True is not a number"),
        ({"scale_range": (0.0, 1.0)}, r"scale_range: \(0.0, 1.0\)"),
        ({"scale_range": (2.0, 1.0)}, r"scale_range: \(2.0, 1.0\)"),
        ({"scale_range": 3}, r"scale_range: 3 is not a pair"),
        ({"gap_tol": -1.0}, r"gap_tol: -1.0"),
        ({"time_limit": 0.0}, r"time_limit: 0.0"),
        ({"node_limit": 0}, r"node_limit: 0"),
        ({"tol": "small"}, r"tol: 'small'.*give a length"),
        ({"threads": 0}, r"threads: 0"),
        ({"threads": 2.5}, r"threads: 2.5 is not a whole number"),
        ({"threads": None}, r"threads: None is not a whole number"),
        ({"bound": "papr"}, r"bound: 'papr' is unknown"),
        ({"bound": 3}, r"bound: 3 is unknown"),
        ({"mode": "best"}, r"mode: 'best' is unknown"),
        ({"mode": ""}, r"mode: '' is unknown"),
        ({"start_box": "tiny"}, r"start_box: 'tiny' is unknown"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {"source": GOOD, "target": GOOD, "n_inliers": 6, "model": "similarity2d"} | change
    with pytest.raises(dcreg.InputError, match=message):
        register(**arguments)


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


def test_default_gap_tol_scales_with_the_square_of_the_target():
    source = np.zeros((5, 2))
    tolerance = default_gap_tol(source, GOOD, 4)
    assert default_gap_tol(source, 3 * GOOD, 4) == pytest.approx(9 * tolerance)
    radius = np.sqrt(((GOOD - GOOD.mean(0)) ** 2).sum(1).mean())
    assert tolerance == pytest.approx(4 * (0.03 * radius) ** 2)


def test_clouds_beyond_memory_are_refused_before_any_work():
    large = np.zeros((20_000, 2))
    with pytest.raises(dcreg.InputError, match="downsample"):
        register(large, large, n_inliers=5, model="similarity2d", mode="paper")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source": np.full((4, 2), 1e300)}, "source: .*too large"),
        ({"scale_range": (1e-300, 1e300)}, "scale_range: .*rescale one cloud"),
    ],
)
def test_numbers_beyond_all_measure_are_refused(change, words):
    given = {"source": GOOD, "target": GOOD, "n_inliers": 3, "model": "similarity2d"}
    with pytest.raises(dcreg.InputError, match=words):
        Problem(**given | change)
