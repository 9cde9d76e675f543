"""Every warning: when it is given, when not, and that it names a remedy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import dcreg
from dcreg import diagnostics
from dcreg.result import Sample
from dcreg.runner_up import find_runner_up
from dcreg.status import Status
from tests.problems import register
from tests.results import event


def clouds(dim=2, size=30, noise=0.01, seed=0):
    generator = np.random.default_rng(seed)
    source = generator.random((size, dim)) * np.array([2.0, 1.0, 0.6])[:dim]
    return source, source + 3.0 + noise * generator.standard_normal(source.shape)


def solve(source, target, k, **options):
    """A result with its warnings."""
    model = "similarity2d" if source.shape[1] == 2 else "rigid3d"
    return register(source, target, n_inliers=k, model=model, **options)


def case(result, source, target, in_norm_space=False, **changes):
    problem = dcreg.Problem(source, target, result.n_inliers, result.model)
    return diagnostics.Case(problem, replace(result, **changes), in_norm_space)


def test_a_good_solve_has_no_warnings():
    assert solve(*clouds(), 30, rel_gap=0.0, abs_gap=1e-4).warnings == []


def test_a_tolerance_above_the_upper_bound():
    result = solve(*clouds(), 30, rel_gap=0.0, abs_gap=1.0)
    (line,) = result.warnings
    assert "The search ended because the pose fits within the tolerance" in line
    assert "Omit abs_gap and tol" in line
    assert result.status is Status.CONVERGED
    assert "converged: fits within the tolerance; not certified" in str(result)
    assert result.to_dict()["warnings"] == result.warnings
    late = diagnostics.nothing_proven(case(result, *clouds(), status=Status.TIME_LIMIT))
    assert "Increase time_limit" in late  # the tolerance did not end this search
    assert "another mode" not in late  # similarity2d has one mode


def test_in_norm_space_a_bound_of_zero_is_not_optimal():
    source, target = clouds(3, noise=0.02)
    vague = solve(source, target, 30, mode="paper", rel_gap=0.0, abs_gap=10.0)
    assert vague.lower_bound == 0.0 < vague.upper_bound
    assert vague.status is Status.CONVERGED
    (line,) = [line for line in vague.warnings if "the lower bound is 0" in line]
    assert "the norms fit within the tolerance" in line  # the pose does not
    default = solve(source, target, 30, mode="paper")
    assert default.status is Status.OPTIMAL
    assert default.lower_bound > 0.0


def test_a_pose_far_worse_than_its_norms():
    source, target = clouds(3)
    result = solve(source, target, 30, mode="paper")

    def warning(in_norm_space=True, **made):
        return diagnostics.surrogate_mismatch(case(result, source, target, in_norm_space, **made))

    made = {"objective": 1.75, "upper_bound": 0.0011}
    assert "mode 'full'" in warning(**made)
    assert warning(in_norm_space=False, **made) is None
    assert warning() is None
    # of a sample: 600 times the bound, but of 30 times the pairs
    sampled = {"upper_bound": 0.01, "downsampled": Sample(9, 9, 1)}
    assert warning(**sampled, objective=6.0) is None
    assert warning(**sampled, objective=60.0)


def test_pairs_that_cost_more_than_the_pose_does():
    source, target = clouds()
    result = solve(source, target, 30)

    def warning(in_norm_space=False, **made):
        return diagnostics.rough_pairs(case(result, source, target, in_norm_space, **made))

    made = {"objective": 44.1, "upper_bound": 19.8}
    assert "cost 44.1, the best pairs" in warning(**made)
    assert warning() is None
    assert warning(in_norm_space=True, **made) is None
    assert warning(**made, downsampled=Sample(9, 9, 1)) is None
    stopped = warning(**made, status=Status.STOPPED)
    assert stopped.startswith("the search was stopped before all pairs")
    assert "Increase time_limit" not in stopped


def test_a_stopped_search_is_not_told_to_take_more_time():
    result = solve(*clouds(), 30)
    made = {"lower_bound": 0.0, "upper_bound": 1.0, "is_exact": False, "status": Status.STOPPED}
    line = diagnostics.nothing_proven(case(result, *clouds(), **made))
    assert line.endswith("because the search was stopped")


def test_no_number_of_pairs_determines_a_pose_of_lines():
    line = np.linspace(0.0, 1.0, 20)[:, None] * np.array([1.0, 2.0, 3.0])
    words = "do not determine the pose. Changing n_inliers does not help"
    for k in (20, 10):
        found = solve(line, line + 0.5, k, time_limit=1.0)
        assert any(words in each for each in found.warnings)


def test_points_in_one_place_have_no_ratio_of_sizes():
    same = dcreg.Problem(np.ones((5, 3)), np.ones((5, 3)), 3, "rigid3d")
    assert not [line for line in dcreg.advice(same) if "RMS radii" in line]


def test_greedy_pairs_are_not_called_too_many():
    source, target = clouds()
    result = solve(source, target, 30)
    late = [*result.stages, dcreg.Stage("all points", 0.1, greedy_assignment=True)]
    greedy, matched = (
        case(result, source, target, objective=50.0, downsampled=Sample(9, 9, 9), stages=stages)
        for stages in (late, result.stages)
    )
    assert "chosen greedily" in diagnostics.rough_pairs(greedy)
    assert diagnostics.loose_pairs(greedy) is None
    assert diagnostics.rough_pairs(matched) is None
    assert "too many" in diagnostics.loose_pairs(matched)


@pytest.mark.parametrize(("shift", "warned"), [(0.0, False), (9.0, True)])
@pytest.mark.parametrize("greedy", [True, False])
def test_large_clouds_are_judged_by_nearest_points(shift, warned, greedy, monkeypatch):
    """Their pairs can be rough or greedy; whether there are too many does not depend on that."""
    monkeypatch.setattr(diagnostics, "is_large", lambda n, m: True)
    source, target = clouds()
    result = solve(source, target, 30)
    late = [*result.stages, dcreg.Stage("all points", 0.1, greedy_assignment=greedy or None)]
    T = result.T_target_source.copy()
    T[:2, 2] += shift
    changes = {"objective": 50.0, "stages": late, "T_target_source": T}
    found = diagnostics.loose_pairs(case(result, source, target, **changes))
    assert bool(found) == warned


@pytest.mark.parametrize(("factor", "warned"), [(4.0, False), (6.0, True)])
def test_large_clouds_with_distant_pairs(factor, warned, monkeypatch):
    monkeypatch.setattr(diagnostics, "is_large", lambda n, m: True)
    source, target = clouds(noise=0.05)
    result = solve(source, target, 20)
    lowest = case(result, source, target).lowest_rmse
    assert lowest <= result.rmse_matched
    distant = case(result, source, target, objective=factor * 20 * lowest**2)
    assert ("connect distant points" in str(diagnostics.distant_pairs(distant))) == warned


def test_a_target_ten_times_larger():
    source, target = clouds()
    lines = solve(source, 12.0 * target, 30, time_limit=2.0).warnings
    assert any("scale_range (0.5, 1.5)" in line and "Widen" in line for line in lines)
    assert any("rescale one" in line and "factor of 10" in line for line in lines)


@pytest.mark.parametrize("scale_range", [(0.5, 50.0), (12.0, 12.0)])
def test_sizes_that_the_scale_explains_are_no_warning(scale_range):
    source, target = clouds()
    result = solve(source, 12.0 * target, 30, scale_range=scale_range)
    assert result.scale == pytest.approx(12.0, rel=0.02)
    assert result.warnings == []


@pytest.mark.parametrize("dim", [2, 3])
def test_a_pose_that_the_pairs_do_not_determine(dim):
    source, target = clouds(dim, size=12)
    assert any("n_inliers" in line for line in solve(source, target, dim - 1).warnings)
    one = solve(source, target, 1).warnings
    more = "determine the pose. Match more pairs (n_inliers)"
    assert any(line.startswith(f"one pair does not {more}") for line in one)
    equal = np.ones((6, dim))
    assert any("coincide and do not determine" in line for line in solve(equal, equal, 6).warnings)
    good = solve(source, target, 12)
    assert diagnostics.undetermined(case(good, source, target)) is None
    source[1] = source[0]
    two = case(good, source, target, n_inliers=2, assignment=np.array([[0, 0], [1, 1]]))
    assert f"the 2 matched source points coincide and do not {more}" in diagnostics.undetermined(
        two
    )
    (line,) = solve(source, 0.0 * target, 12, time_limit=1.0).warnings[:1]
    assert (
        line
        == "the 12 matched target points coincide and do not determine the pose. Changing n_inliers "
        "does not help"
    )


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("n_inliers", [0.9, "auto"])
def test_a_cloud_without_extent_has_one_warning_and_no_other_pose(dim, n_inliers):
    equal = np.ones((6, dim))
    result = solve(equal, equal + 1.0, n_inliers)
    assert result.runner_up is None
    (line,) = result.warnings
    assert (
        "source points coincide and do not determine the pose. Changing n_inliers does not help"
        in line
    )


def test_two_points_on_two_have_no_other_number_of_pairs():
    two = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    (line,) = solve(two, two + 1.0, "auto").warnings
    assert "source points lie on one line and do not determine the pose. Changing" in line


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(
    ("size", "k", "warned"), [(60, 3, True), (60, 45, False), (10, 5, False), (10, 10, False)]
)
def test_pairs_that_unrelated_clouds_would_fit_as_well(dim, size, k, warned):
    lines = solve(*clouds(dim, size), k, time_limit=2.0).warnings
    assert any("too few" in line and "larger n_inliers" in line for line in lines) == warned


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("k", [3, 5, 9])
def test_unrelated_clouds_fit_by_chance(dim, k):
    generator = np.random.default_rng(k)
    source, target = generator.random((2, 24, dim))
    assert any("too few" in line for line in solve(source, target, k, time_limit=1.0).warnings)


def test_few_pairs_that_fit_exactly_are_meaningful():
    source, _ = clouds(3)
    result = solve(source, source[::-1] + 1.0, 6)
    assert diagnostics.few_pairs(case(result, source, source[::-1] + 1.0)) is None


@pytest.mark.parametrize(("spacings", "warned"), [(1.5, False), (2.5, True)])
def test_pairs_looser_than_the_points_are_spaced(spacings, warned):
    source, target = clouds()
    spacing = np.median(np.sort(cdist(target, target), axis=1)[:, 1])
    objective = 20 * (spacings * spacing) ** 2
    loose = case(solve(source, target, 20), source, target, objective=objective)
    assert ("smaller n_inliers" in str(diagnostics.loose_pairs(loose))) == warned


@pytest.mark.parametrize(
    ("status", "uppers", "n_nodes", "warned"),
    [
        (Status.TIME_LIMIT, [9.0, 1.0, 1.0], 50, True),
        (Status.TIME_LIMIT, [9.0, 9.0, 9.0, 1.0], 50, False),
        (Status.TIME_LIMIT, [1.0], 0, False),
        (Status.CONVERGED, [9.0, 9.0, 9.0, 1.0], 50, True),
    ],
)
def test_pairs_are_not_called_too_many_if_the_search_was_cut_short(status, uppers, n_nodes, warned):
    source, target = clouds()
    trace = dcreg.Trace([event(time_s=float(at), upper=upper) for at, upper in enumerate(uppers)])
    changes = {"objective": 100.0, "status": status, "trace": trace, "n_nodes": n_nodes}
    loose = case(solve(source, target, 20), source, target, **changes)
    assert bool(diagnostics.loose_pairs(loose)) == warned


def test_pairs_are_not_called_too_many_if_the_scales_differ():
    source, target = clouds(noise=0.05)
    for factor in (3.0, 12.0):
        lines = solve(source, factor * target, 30, time_limit=2.0).warnings
        assert any("rescale one cloud" in line for line in lines)
        assert not any(diagnostics.TOO_MANY_PAIRS in line for line in lines)


def test_a_sampled_search_is_not_asked_for_a_sample():
    source, target = clouds(3)
    result = solve(source, target, 30)
    late = [*result.stages, dcreg.Stage("all points", 0.1, greedy_assignment=True)]
    sampled = case(result, source, target, stages=late, downsampled=Sample(9, 9, 9), objective=9.0)
    line = diagnostics.rough_pairs(sampled)
    assert "Allow more time" in line
    assert "--downsample" not in line


def test_too_many_points():
    source, target = clouds(size=1200)
    result = solve(source[:20], target[:20], 20)
    late = case(result, source, target, status=Status.TIME_LIMIT)
    assert "--downsample" in diagnostics.too_many_points(late)
    assert diagnostics.too_many_points(case(result, source, target)) is None
    stopped = case(result, source, target, status=Status.STOPPED)  # not by the clock
    assert diagnostics.too_many_points(stopped) is None
    grey = dcreg.Attributes(np.arange(1200.0), np.arange(900.0), scale=1e-3)
    problem = dcreg.Problem(source, target[:900], 20, "similarity2d").with_attributes(grey)
    line = diagnostics.too_many_points(replace(late, problem=problem))
    assert line.endswith(
        "are too many for this time limit. Give fewer points"
    )  # a sample is refused


def cluttered(n_true=25, n_clutter=55, seed=1):
    """Two 2D clouds that share `n_true` points, turned by 69 degrees, among dense clutter."""
    generator = np.random.default_rng(seed)
    shared = generator.random((n_true, 2)) * [2.0, 1.0]
    turn = np.array([[np.cos(1.2), -np.sin(1.2)], [np.sin(1.2), np.cos(1.2)]])
    image = shared @ turn.T + 0.005 * generator.standard_normal((n_true, 2))
    source = np.concatenate([shared, generator.random((n_clutter, 2)) * [2.0, 1.0]])
    return source, np.concatenate([image, generator.random((n_clutter, 2)) * [2.0, 1.0] @ turn.T])


@pytest.mark.parametrize(("k", "right"), [(25, True), (65, False)])
def test_too_many_pairs_in_clutter_have_a_runner_up_pose_nearly_as_good(k, right):
    result = solve(*cluttered(), k, node_limit=2000)
    assert (abs(result.rotation_deg - np.degrees(1.2)) < 2.0) == right
    assert (result.runner_up.objective_ratio > 3.0) == right
    assert any("another pose" in line for line in result.warnings) == (not right)
    assert "runner-up pose" in str(result)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_symmetric_shape_has_a_runner_up_of_the_same_cost(dim):
    grid = np.stack(np.meshgrid(*[np.arange(4) * step for step in (2.0, 1.1, 0.5)[:dim]]), axis=-1)
    grid = grid.reshape(-1, dim)
    noisy = grid + 0.02 * np.random.default_rng(0).standard_normal(grid.shape)
    result = solve(grid, noisy, len(grid) - 1)
    assert result.runner_up.objective_ratio == pytest.approx(1.0, abs=0.3)
    assert result.runner_up.rotation_difference_deg == pytest.approx(180.0, abs=3.0)
    assert any("may be symmetric" in line for line in result.warnings)
    made = result.to_dict()["runner_up"]
    T = np.array(made["T_target_source"])
    residual = cdist(grid @ T[:dim, :dim].T + T[:dim, dim], noisy).min(axis=1)
    assert np.sqrt((residual**2).mean()) < 0.1


@pytest.mark.parametrize(
    ("shift", "ratio", "differs"),
    [(0.04, 1.01, True), (0.04, 1.03, False), (0.025, 1.01, False), (0.3, 1.5, True)],
)
def test_an_equally_good_pose_close_by_is_a_runner_up(shift, ratio, differs):
    """Beyond three RMS residuals, here 0.03; beyond a fifth of the radius, here 0.13, if it is worse."""
    source, target = clouds()
    problem = dcreg.Problem(source, target, 30, "similarity2d")
    other, objective = np.eye(3), 30 * 0.01**2
    other[0, 2] = shift
    found = find_runner_up(problem, np.eye(3), objective, [(other, ratio * objective)])
    assert (found is not None) == differs


def test_a_pose_close_by_is_no_runner_up():
    source, target = clouds()
    problem = dcreg.Problem(source, target, 30, "similarity2d")
    near, far, open_end = np.eye(3), np.eye(3), np.eye(3)
    near[0, 2], far[0, 2] = 0.01, 1.0
    assert find_runner_up(problem, np.eye(3), 1.0, [(near, 1.0), (open_end, np.inf)]) is None
    found = find_runner_up(problem, np.eye(3), 2.0, [(near, 1.0), (far, 5.0)])
    assert (found.objective_ratio, found.rotation_difference_deg) == pytest.approx((2.5, 0.0))
    assert found.rms_displacement == pytest.approx(1.0)
    assert "displaced by 1 (RMS), rotated by 0 deg" in str(found)
