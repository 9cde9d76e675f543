"""`register` end to end: recovered poses, units, limits, modes, downsampling, awkward problems."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.driver import modes
from dcreg.driver.modes import LARGE_PAIRS, LARGE_SAMPLE, choose_mode
from dcreg.problem import Frame, Problem, apply_pose
from dcreg.status import Status
from tests.problems import register

BOUNDS_2D = ["dc", "interval", "dc+interval"]


@pytest.fixture
def planar(rng):
    source = rng.random((25, 2)) * [3.0, 1.0]
    c, s = 1.2 * np.cos(2.1), 1.2 * np.sin(2.1)
    T = np.array([[c, -s, 40.0], [s, c, -7.0], [0, 0, 1]])
    return source, apply_pose(T, source), T


@pytest.fixture
def spatial(rng):
    source = rng.standard_normal((30, 3)) * [1.0, 0.6, 0.3]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.4, 1.9, -0.8]).as_matrix()
    T[:3, 3] = [5.0, -3.0, 11.0]
    return source, apply_pose(T, source), T


@pytest.mark.parametrize("bound", BOUNDS_2D)
def test_similarity_is_recovered_with_a_certificate(planar, bound):
    source, target, T = planar
    result = register(source, target, n_inliers=25, model="similarity2d", bound=bound)
    assert result.status is Status.OPTIMAL
    np.testing.assert_allclose(result.T_target_source, T, atol=1e-6)
    assert result.lower_bound <= result.upper_bound
    assert result.gap <= result.gap_tol
    assert result.certificate_scope == "similarity pose"
    assert result.scale == pytest.approx(1.2)
    assert (result.assignment[:, 0] == result.assignment[:, 1]).all()


def test_rigid_pose_is_recovered_and_proper(spatial):
    source, target, T = spatial
    result = register(source, target, n_inliers=30, model="rigid3d", mode="paper")
    assert result.status is Status.OPTIMAL
    np.testing.assert_allclose(result.T_target_source, T, atol=1e-5)
    assert np.linalg.det(result.rotation) == pytest.approx(1.0)
    assert result.certificate_scope == "translation in norm space"
    assert [stage.name for stage in result.stages] == ["search", "rotation", "polish"]


def test_mirrored_cloud_never_gives_a_reflection(spatial):
    source, target, _ = spatial
    result = dcreg.register(source * [-1, 1, 1], target, n_inliers=30, model="rigid3d")
    assert np.linalg.det(result.T_target_source[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_units_of_the_files_scale_pose_and_bounds(planar, unit, rng):
    source, target, _ = planar
    target = target + 0.02 * rng.standard_normal(target.shape)
    # rounding shifts the counters of the bound "tight"
    one, other = (
        register(u * source, u * target, n_inliers=20, model="similarity2d", bound="dc")
        for u in (1.0, unit)
    )
    default = dcreg.register(unit * source, unit * target, n_inliers=20, model="similarity2d")
    assert default.status is Status.OPTIMAL
    assert default.upper_bound == pytest.approx(other.upper_bound, rel=1e-6)
    assert default.gap_tol == pytest.approx(other.gap_tol, rel=1e-6)
    np.testing.assert_allclose(default.T_target_source, other.T_target_source, atol=1e-6 * unit)
    assert other.n_nodes == one.n_nodes
    for name in ("lower_bound", "upper_bound", "gap_tol", "objective"):
        assert getattr(other, name) == pytest.approx(unit**2 * getattr(one, name), rel=1e-6)
    np.testing.assert_allclose(other.translation, unit * one.translation, rtol=1e-6)


def test_bounds_and_objective_are_in_file_coordinates(planar, rng):
    source, target, _ = planar
    target = target + 0.05 * rng.standard_normal(target.shape)
    result = dcreg.register(source, target, n_inliers=25, model="similarity2d")
    value, pairs = dcreg.objective(source, target, result.T_target_source, 25)
    assert result.objective == pytest.approx(value)
    assert result.lower_bound <= value <= result.upper_bound + 1e-9
    assert result.rmse_matched == pytest.approx(np.sqrt(value / 25))
    residuals = apply_pose(result.T_target_source, source)[pairs[:, 0]] - target[pairs[:, 1]]
    assert (residuals**2).sum() == pytest.approx(value)


def test_polish_does_not_change_the_certificate(spatial, rng):
    source, target, _ = spatial
    target = target + 0.03 * rng.standard_normal(target.shape)
    polished = register(source, target, n_inliers=30, model="rigid3d", mode="paper")
    plain = register(source, target, n_inliers=30, model="rigid3d", mode="paper", polish=False)
    np.testing.assert_array_equal(plain.T_target_source, plain.T_certified)
    np.testing.assert_array_equal(plain.T_certified, polished.T_certified)
    assert polished.upper_bound == plain.upper_bound
    assert polished.objective <= polished.objective_certified == plain.objective


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
def test_threads_change_nothing(model, planar, spatial, rng):
    source, target, _ = planar if model == "similarity2d" else spatial
    target = target + 0.05 * rng.standard_normal(target.shape)
    settings = {"model": model, "node_limit": 5000, "time_limit": None, "bound": "dc"}
    one, two = (
        register(source, target, n_inliers=0.8, threads=threads, **settings) for threads in (1, 2)
    )
    for name in ("n_nodes", "n_assignments", "lower_bound"):
        assert getattr(one, name) == getattr(two, name)
    np.testing.assert_array_equal(one.T_target_source, two.T_target_source)


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
def test_node_limit_returns_the_best_pose_with_valid_bounds(model, planar, spatial, rng):
    source, target, _ = planar if model == "similarity2d" else spatial
    target = target + 0.2 * rng.standard_normal(target.shape)
    result = register(
        source,
        target,
        n_inliers=0.6,
        model=model,
        node_limit=3,
        rel_gap=0.0,
        abs_gap=1e-9,
        bound="dc",
    )
    assert result.status is Status.NODE_LIMIT
    assert np.isfinite(result.T_target_source).all()
    assert 0 <= result.lower_bound <= result.upper_bound < np.inf


def test_one_pair_and_single_points():
    result = dcreg.register([[1.0, 2.0]], [[5.0, 5.0]], n_inliers=1, model="similarity2d")
    assert result.status is Status.OPTIMAL
    assert result.objective == pytest.approx(0.0, abs=1e-12)


def test_all_target_points_equal():
    source = np.random.default_rng(3).random((6, 2))
    target = np.zeros((6, 2)) + 4.0
    result = dcreg.register(source, target, n_inliers=6, model="similarity2d")
    assert result.scale == pytest.approx(0.5)  # the minimum admissible scale is best


def test_trace_is_monotone_within_a_stage_and_ends(spatial):
    source, target, _ = spatial
    result = register(source, target, n_inliers=20, model="rigid3d", mode="paper")
    for stage in ("search", "rotation"):
        events = [event for event in result.trace if event.stage == stage]
        assert events[-1].kind == "end"
        lower = [event.lower_bound for event in events]
        assert lower == sorted(lower)


@pytest.mark.parametrize(
    ("n", "m", "k", "settings", "mode"),
    [
        (30, 30, 20, {}, "full"),
        (200, 200, 200, {}, "full"),
        (60, 60, 50, {}, "full"),
        (1000, 1200, 800, {}, "full"),
        (2100, 2000, 2000, {}, "paper"),
        (30, 30, 30, {"bound": "interval"}, "paper"),
        (30, 30, 30, {"certificate": True}, "full"),
        (500, 500, 400, {"certificate": True}, "paper"),
    ],
)
def test_auto_selects_the_mode_for_the_problem(n, m, k, settings, mode, rng):
    source, target = rng.standard_normal((n, 3)), rng.standard_normal((m, 3))
    assert choose_mode(Problem(source, target, k, "rigid3d"), **settings) == mode
    few = Problem(source, target, k, "rigid3d", candidates=np.eye(n, m, dtype=bool))
    assert choose_mode(few, **settings) == mode
    flat = Problem(source[:, :2], target[:, :2], k, "similarity2d")
    assert choose_mode(flat, **settings) == "paper"


@pytest.mark.parametrize("asked", [None, "auto"])
def test_result_states_the_mode_that_ran(asked, spatial):
    source, target, T = spatial
    full = register(source, target, n_inliers=30, model="rigid3d", mode=asked)
    assert (full.mode, full.bound, full.certificate_scope) == ("full", "rigid", "rigid pose")
    assert full.status is Status.OPTIMAL
    np.testing.assert_allclose(full.T_target_source, T, atol=1e-5)
    paper = register(source, target, n_inliers=30, model="rigid3d", mode=asked, bound="tight")
    assert (paper.mode, paper.certificate_scope) == ("paper", "translation in norm space")


def test_full_mode_bounds_the_objective_it_reports(spatial, rng):
    source, target, _ = spatial
    target = target + 0.05 * rng.standard_normal(target.shape)
    result = register(source, target, n_inliers=30, model="rigid3d", mode="full")
    assert result.status is Status.OPTIMAL
    assert result.lower_bound <= result.objective <= result.upper_bound + 1e-9


@pytest.mark.parametrize(
    ("model", "mode"), [("similarity2d", "paper"), ("rigid3d", "paper"), ("rigid3d", "full")]
)
def test_certificate_of_a_search_is_verified_separately(
    model, mode, planar, spatial, rng, tmp_path
):
    source, target, _ = planar if model == "similarity2d" else spatial
    target = target + 0.05 * rng.standard_normal(target.shape)
    result = register(source, target, n_inliers=0.8, model=model, mode=mode, certificate=True)
    result.write_certificate(tmp_path / "proof.npz")
    report = dcreg.verify(tmp_path / "proof.npz", source, target)
    assert report.accepted, report.reason
    needed = result.upper_bound - result.gap_tol if mode == "full" else result.lower_bound
    assert report.lower_bound == pytest.approx(needed)
    assert report.upper_bound == pytest.approx(result.upper_bound)
    assert not dcreg.verify(tmp_path / "proof.npz", source + 1e-3, target).accepted


def test_a_certificate_is_searched_to_the_limits_like_a_proof():
    assert dcreg.SolveOptions(certificate=True).must_prove
    assert dcreg.SolveOptions(prove=True).must_prove
    assert not dcreg.SolveOptions().must_prove


def test_a_bound_that_is_asked_for_works_alone(rng):
    source = rng.random((40, 2))
    target = source + 0.02 * rng.standard_normal(source.shape)
    target[30:] = rng.random((10, 2))
    default, named = (
        dcreg.register(
            source, target, n_inliers=30, model="similarity2d", node_limit=20_000,
            options=dcreg.SolveOptions(bound=bound),
        )
        for bound in (None, "tight")
    )  # fmt: skip
    assert "distances" in {stage.name for stage in default.stages}
    assert "distances" not in {stage.name for stage in named.stages}
    assert default.status is named.status is Status.OPTIMAL
    assert default.objective == pytest.approx(named.objective)


def test_mode_full_refuses_what_it_would_ignore(spatial):
    source, target, _ = spatial
    with pytest.raises(dcreg.InputError, match="bound: mode 'full' has its own bounds"):
        register(source, target, n_inliers=30, model="rigid3d", mode="full", bound="tight")


def test_a_fixed_scale_leaves_rotation_and_translation(planar):
    source, target, T = planar
    fixed, other = (
        dcreg.register(source, target, n_inliers=25, model="similarity2d", scale_range=(s, s))
        for s in (1.2, 1.0)
    )
    assert fixed.scale == pytest.approx(1.2, rel=1e-12)
    np.testing.assert_allclose(fixed.T_target_source, T, atol=1e-6)
    assert other.status is Status.OPTIMAL
    assert other.scale == pytest.approx(1.0, rel=1e-12)
    assert other.objective > 0.1


def test_coinciding_points_do_not_define_the_unit_of_length():
    source = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])
    target = np.array([[0.1, 0.7]]) + np.zeros((3, 1))  # its mean is a rounding error away
    target[1] = np.nextafter(target[1], 1.0)
    frame = Frame.of(Problem(source, target, 2, "similarity2d"))
    assert frame.unit == pytest.approx(np.sqrt(16.0 / 9.0))


# --- downsampling -----------------------------------------------------------------------------------


def test_downsampled_clouds_are_searched_and_the_pose_is_refined_on_all_points(rng):
    source = rng.random((300, 2)) * [2.0, 1.0]
    source[:, 1] += source[:, 0] ** 2
    target = rng.permutation(source + 3.0)
    settings = {"model": "similarity2d", "time_limit": 20, "downsample": 40}
    result = register(source, target, n_inliers=300, **settings)
    assert result.downsampled == (40, 40, 40)
    assert result.n_inliers == len(result.assignment) == 300
    assert result.n_bounded == 40
    np.testing.assert_allclose(result.translation, [3.0, 3.0], atol=1e-6)
    assert result.objective < 1e-12
    assert "downsampled" in str(result)
    content = result.to_dict()
    assert content["downsampled"] == {"n_source": 40, "n_target": 40, "n_inliers": 40}
    assert content["certificate_scope"] == "similarity pose of the sample"


def test_the_pose_of_a_sample_is_refined_also_where_its_search_ends_at_the_limit(rng):
    source = rng.random((300, 3)) * [2.0, 1.0, 0.5]
    target = source + 3.0 + 0.01 * rng.standard_normal(source.shape)
    result = register(
        source,
        target,
        n_inliers=0.2,
        model="rigid3d",
        rel_gap=0.0,
        abs_gap=0.0,
        time_limit=2.0,
        downsample=60,
        prove=True,
    )
    assert result.status is dcreg.Status.TIME_LIMIT
    last = result.stages[-1]
    assert last.name == "all points"
    assert last.n_assignments > 1
    assert last.objective_after < last.objective_before


def test_progress_names_the_refinement_of_a_sample(rng):
    source, events = rng.random((60, 3)) * [2.0, 1.0, 0.5], []
    target = source + 3.0 + 0.01 * rng.standard_normal(source.shape)
    settings = {"n_inliers": 50, "model": "rigid3d", "downsample": 30, "listener": events.append}
    result = register(source, target, **settings)
    assert {event.stage for event in result.trace} == {"start", "rigid"}
    _, *refining = events[events.index(result.trace.events[-1]) :]
    assert {event.stage for event in refining} == {"all points"}
    assert np.isinf(refining[0].upper_bound)
    assert refining[-1].upper_bound == pytest.approx(result.objective)


def test_a_part_is_registered_in_a_whole_that_is_larger(rng):
    """The initial poses come from fewer points; the pairs are scaled with the smaller share of them."""
    turn = np.sort(2.0 * np.pi * rng.random(900))
    curve = [np.cos(turn) * (1.0 + 0.1 * turn), np.sin(turn), 0.1 * turn + 0.3 * np.sin(3.0 * turn)]
    whole = np.column_stack(curve) + 0.05 * rng.standard_normal((900, 3))
    angle = 1.1
    R = np.array(
        [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0, 0, 1]]
    )
    part = (whole[250:550] - [1.0, 2.0, 3.0]) @ R + 0.002 * rng.standard_normal((300, 3))
    result = register(part, whole, n_inliers=300, model="rigid3d", time_limit=20.0)
    assert result.downsampled is None
    assert result.n_inliers == len(result.assignment) == 300
    assert dcreg.problem.rotation_angle_deg(result.rotation @ R.T) < 0.5
    assert np.allclose(result.translation, [1.0, 2.0, 3.0], atol=0.02)


def test_downsampling_leaves_small_clouds_alone(rng):
    source = rng.random((20, 2))
    result = register(source, source, n_inliers=20, model="similarity2d", downsample=50)
    assert result.downsampled is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"downsample": 0}, "downsample: 0"),
        ({"downsample": 2.5}, "downsample: 2.5"),
        ({"downsample": 5, "candidates": ~np.eye(20, dtype=bool)}, "downsample: candidates"),
        ({"downsample": 5, "certificate": True}, "downsample: certificate"),
    ],
)
def test_downsampling_refuses_what_it_would_ignore(rng, options, words):
    source = rng.random((20, 2))
    with pytest.raises(dcreg.InputError, match=words):
        register(source, source, n_inliers=20, model="similarity2d", **options)


def test_large_2d_clouds_are_searched_by_a_sample(rng):
    source = rng.random((2_400, 2)) * [2.0, 1.0]
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    target = source[:1_800] @ turn.T + 0.002 * rng.standard_normal((1_800, 2))
    settings = {"n_inliers": 1_500, "model": "similarity2d"}
    found = dcreg.register(source, target, **settings, time_limit=3.0)
    assert found.downsampled == (300, 300, 188)
    assert found.rotation_deg == pytest.approx(90.0, abs=0.5)
    assert len(found.assignment) == 1_500
    paper = register(source, target, **settings, time_limit=0.1, mode="paper")
    assert paper.downsampled is None


def test_large_clouds_are_searched_by_a_sample_in_3d(monkeypatch):
    """Mode `paper` finds no right pose of very large clouds in time, even if all points match."""
    monkeypatch.setitem(LARGE_PAIRS, 3, 900)
    monkeypatch.setitem(LARGE_SAMPLE, 3, 25)
    monkeypatch.setattr(modes, "NORM_PAIRS", 900)
    generator = np.random.default_rng(0)
    source = generator.random((40, 3)) * [2.0, 1.0, 0.5]
    target = source[:, [1, 2, 0]] + 1.0
    part = dcreg.register(source, target, n_inliers=0.8, model="rigid3d", time_limit=5.0)
    assert (part.mode, part.downsampled) == ("full", (25, 25, 20))
    whole = dcreg.register(source, target, n_inliers=40, model="rigid3d", time_limit=5.0)
    assert (whole.mode, whole.downsampled) == ("full", (25, 25, 25))


@pytest.mark.parametrize(("model", "dim"), [("similarity2d", 2), ("rigid3d", 3)])
@pytest.mark.parametrize("offset", [1e4, 1e6])
def test_targets_far_from_the_origin_are_registered(model, dim, offset):
    """All points match, so the minimum and the maximum mean are equal except for rounding."""
    for n in range(20, 28):
        source = np.random.default_rng(n - 20).normal(size=(n, dim))
        target = source[::-1] + offset
        found = dcreg.register(source, target, n_inliers=n, model=model, time_limit=5.0)
        assert found.status == "optimal"
        assert found.objective < 1e-6


def test_one_pair_far_from_the_origin_is_not_called_greedy():
    generator = np.random.default_rng(0)
    for _ in range(40):
        source, target = generator.normal(size=(1, 3)), 10.0 * generator.normal(size=(1, 3))
        found = dcreg.register(source, target, n_inliers=1, model="rigid3d")
        assert not any("before all pairs" in warning for warning in found.warnings)


def test_initial_poses_worse_than_the_initial_guess_are_not_reported():
    rng = np.random.default_rng(3)
    source, target = rng.random((30, 3)), rng.random((30, 3))
    options = {"n_inliers": 15, "model": "rigid3d", "node_limit": 1}
    best = dcreg.register(source, target, **options).T_target_source
    guess = dcreg.SolveOptions(init=best)
    found = dcreg.register(source, target, **options, options=guess)
    upper = [event.upper_bound for event in found.trace if event.stage == "start"]
    assert upper == sorted(upper, reverse=True)
    assert upper[0] == pytest.approx(min(upper))
