"""Sweeps over the cardinality: the same optima as single calls, for less work."""

import itertools
import json
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.diagnostics import TOO_MANY_PAIRS
from dcreg.driver import modes
from dcreg.driver.modes import LARGE_PAIRS, LARGE_SAMPLE
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.problem import InputError, rms_radius
from dcreg.search import Budget
from dcreg.status import Status
from tests.clocks import Stopwatch
from tests.problems import register, sweep

COUNTS = [16, 17, 18, 19, 20, 22, 24]


def flat(n_common=20, n_points=24, noise=0.02, seed=4):
    """2D clouds with noise on the common points and clutter in place of the rest."""
    rng = np.random.default_rng(seed)
    source = rng.random((n_points, 2)) * [2.0, 1.0]
    target = source + noise * rng.standard_normal((n_points, 2))
    target[n_common:] = rng.random((n_points - n_common, 2)) * [2.0, 1.0]
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    return source, 1.1 * target @ turn.T + [5.0, -3.0]


def solid(n_common=20, n_points=24, noise=0.03, seed=1):
    rng = np.random.default_rng(seed)
    source = rng.standard_normal((n_points, 3)) * [1.0, 0.7, 0.4]
    target = source + noise * rng.standard_normal((n_points, 3))
    target[n_common:] = rng.standard_normal((n_points - n_common, 3))
    return source, target @ Rotation.from_rotvec([0.4, 1.9, -0.8]).as_matrix().T + 0.3


@pytest.fixture(scope="module")
def clouds():
    return flat()


@pytest.fixture(scope="module")
def found(clouds):
    return dcreg.sweep(*clouds, COUNTS, model="similarity2d")


@pytest.fixture(scope="module")
def separate(clouds):
    return [dcreg.register(*clouds, n_inliers=k, model="similarity2d") for k in COUNTS]


@pytest.fixture(scope="module")
def loose(clouds):
    """With a tolerance that exceeds the differences between the values per pair."""
    tol = 0.03 * rms_radius(clouds[1])
    return dcreg.sweep(*clouds, COUNTS, model="similarity2d", rel_gap=0.0, tol=tol)


def test_every_optimum_is_that_of_a_single_call(found, separate):
    assert [result.n_inliers for result in found.results] == COUNTS
    assert found.status is Status.OPTIMAL
    for mine, alone in zip(found.results, separate, strict=True):
        assert mine.status is Status.OPTIMAL
        assert mine.gap <= mine.gap_tol == alone.gap_tol
        assert mine.lower_bound <= alone.upper_bound + 1e-12
        assert alone.lower_bound <= mine.upper_bound + 1e-12
        assert mine.upper_bound <= alone.upper_bound + mine.gap_tol


def test_one_search_serves_several_cardinalities(clouds, loose):
    """A sweep saves about a third of the nodes here."""
    tol = 0.03 * rms_radius(clouds[1])
    settings = {"model": "similarity2d", "rel_gap": 0.0, "tol": tol}
    nodes = [result.n_nodes for result in loose.results]
    alone = [dcreg.register(*clouds, n_inliers=k, **settings).n_nodes for k in COUNTS]
    assert sum(nodes) < 0.7 * sum(alone)
    # the objective for 16 pairs is below the tolerance; 18 and 20 are certified by other searches
    assert loose.proven_by == [None, 17, 17, 19, 19, 22, 24]
    for k, n, by in zip(COUNTS, nodes, loose.proven_by, strict=True):
        assert (n > 0) == (by == k)


def test_what_fits_within_the_tolerance_is_not_optimal(loose):
    first, *others = loose.results
    assert first.lower_bound == 0.0 < first.upper_bound <= first.gap_tol
    assert first.status is loose.status is Status.CONVERGED
    assert all(result.status is Status.OPTIMAL for result in others)


def test_transferred_bound_is_the_share_of_the_one_it_comes_from(loose):
    by_count = {result.n_inliers: result for result in loose.results}
    for result, by in zip(loose.results, loose.proven_by, strict=True):
        if by is not None:
            expected = by_count[by].lower_bound * result.n_inliers / by
            assert result.lower_bound == pytest.approx(expected, rel=1e-12)


def test_search_uses_the_gap_that_the_whole_run_needs(loose):
    by_count = {result.n_inliers: result for result in loose.results}
    (search,) = [stage for stage in by_count[17].stages if stage.name == "search"]
    needed = 17 / 18 * (by_count[18].upper_bound - by_count[18].gap_tol)
    assert search.gap_tol == pytest.approx(by_count[17].upper_bound - needed, rel=1e-5)
    assert 0.5 * by_count[17].gap_tol <= search.gap_tol < by_count[17].gap_tol


def test_a_good_pose_reaches_all_cardinalities(clouds, separate, monkeypatch):
    start = Similarity2D.start

    def only_for_18(space, budget, enough, known):
        if space.n_inliers == 18:
            return start(space, budget, enough, known)
        return space.identity, space.objective(space.identity)[0], 1

    monkeypatch.setattr(Similarity2D, "start", only_for_18)
    swept = dcreg.sweep(*clouds, COUNTS, model="similarity2d", node_limit=1)
    for mine, alone in zip(swept.results, separate, strict=True):
        assert mine.upper_bound == pytest.approx(alone.upper_bound, rel=1e-3)


def test_pose_attains_the_upper_bound(clouds, found):
    for result in found.results:
        value, pairs = dcreg.objective(*clouds, result.T_certified, result.n_inliers)
        assert value == pytest.approx(result.upper_bound, rel=1e-9)
        assert result.objective <= result.upper_bound * (1.0 + 1e-9)
        assert len(result.assignment) == len(pairs) == result.n_inliers


def test_suggested_is_where_the_clutter_begins(found):
    assert found.suggested_n_inliers == 20


@pytest.mark.parametrize("counts", [[16, 18, 20, 22], [18, 19, 20, 21, 22, 23, 24], [12, 20, 24]])
def test_suggestion_does_not_depend_on_where_the_sweep_begins_and_ends(clouds, counts):
    assert dcreg.sweep(*clouds, counts, model="similarity2d").suggested_n_inliers == 20


def test_no_suggestion_exceeds_the_warning_of_too_many_pairs(found):
    def warned(counts):
        line = f"some {TOO_MANY_PAIRS}"
        results = [
            replace(r, warnings=[line] if r.n_inliers in counts else []) for r in found.results
        ]
        return replace(found, results=results).suggested_n_inliers

    larger = [r.n_inliers for r in found.results if r.n_inliers > 20]
    assert warned(larger) == 20
    assert warned([20, *larger]) < 20
    assert warned([r.n_inliers for r in found.results]) is None


def test_no_suggestion_where_nothing_stands_out(clouds):
    source, _ = clouds
    for counts in ([10, 20], [10, 15, 20]):  # too few, and no residual at all
        exact = dcreg.sweep(source, source, counts, model="similarity2d")
        assert exact.suggested_n_inliers is None


def test_rows_enclose_the_marginal_cost(found):
    rows = found.rows()
    assert rows[-1]["marginal_cost"] is None
    for row in rows:
        assert row["rms_lower"] <= row["rms"]
    for row, after in itertools.pairwise(rows):
        more = after["n_inliers"] - row["n_inliers"]
        rise = after["upper_bound"] - row["upper_bound"]
        assert row["marginal_cost"] == pytest.approx(rise / more)
        assert (
            0.0 <= row["marginal_cost_lower"] <= row["marginal_cost"] <= row["marginal_cost_upper"]
        )


def test_lists_in_any_order_and_with_repetitions(clouds):
    mixed = dcreg.sweep(*clouds, (24, 0.75, 20, np.int64(20), 18, 1.0), model="similarity2d")
    ordered = dcreg.sweep(*clouds, [18, 20, 24], model="similarity2d")
    assert [result.n_inliers for result in mixed.results] == [18, 20, 24]
    for a, b in zip(mixed.results, ordered.results, strict=True):
        for name in ("upper_bound", "lower_bound", "n_nodes"):
            assert getattr(a, name) == getattr(b, name)


def test_a_sweep_rejects_a_certificate(clouds):
    options = dcreg.SolveOptions(certificate=True)
    with pytest.raises(InputError, match=r"^certificate: a sweep"):
        dcreg.sweep(*clouds, [18], model="similarity2d", options=options)


def test_a_single_cardinality_is_a_single_search(clouds, separate):
    (only,) = dcreg.sweep(*clouds, [18], model="similarity2d").results
    alone = separate[COUNTS.index(18)]
    assert (only.n_nodes, only.upper_bound) == (alone.n_nodes, alone.upper_bound)


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ([10, 0], "n_inliers: 0"),
        ([0.5, 1.5], r"n_inliers.*1\.5.*\(0, 1\]"),
        ([10, "many"], "n_inliers.*'many'"),
    ],
)
def test_bad_cardinalities_are_refused_before_any_search(clouds, counts, words):
    with pytest.raises(InputError, match=words):
        sweep(*clouds, counts, model="similarity2d", listener=lambda _: pytest.fail("ran"))


def test_limits_leave_valid_bounds_everywhere(clouds, separate):
    limited = dcreg.sweep(*clouds, COUNTS, model="similarity2d", node_limit=40)
    assert limited.status is Status.NODE_LIMIT
    for mine, alone in zip(limited.results, separate, strict=True):
        assert mine.lower_bound <= alone.upper_bound
        assert mine.upper_bound >= alone.lower_bound
        assert np.isfinite(mine.T_target_source).all()
        assert mine.status is (Status.OPTIMAL if mine.gap <= mine.gap_tol else Status.NODE_LIMIT)


def test_time_limit_covers_the_whole_sweep_and_keeps_what_is_finished(processor_clock):
    watch, limit = Stopwatch(), 3.0
    settings = {"model": "similarity2d", "time_limit": limit, "bound": "dc", "listener": watch}
    limited = sweep(*flat(40, 60, noise=0.05), [20, 25, 30, 60], **settings)
    assert watch.since_first() <= 1.1 * limit + 1.0
    assert limited.status is Status.TIME_LIMIT
    # the difficult cardinalities leave time for the easy one
    assert limited.results[-1].status is Status.OPTIMAL
    for result in limited.results:
        assert 0.0 <= result.lower_bound <= result.upper_bound < np.inf


def test_listener_stops_the_sweep(clouds):
    stages = []

    def listener(event):
        if event.stage.startswith("k="):
            stages.append(event.stage)
        return len(set(stages)) == 2  # in the second search

    stopped = sweep(*clouds, COUNTS, model="similarity2d", listener=listener)
    assert len(set(stages)) == 2
    statuses = [result.status for result in stopped.results]
    assert statuses[0] is Status.OPTIMAL
    assert Status.STOPPED in statuses
    assert set(statuses) == {Status.OPTIMAL, Status.STOPPED}


@pytest.mark.usefixtures("thin_slices")
def test_threads_do_not_change_the_result(clouds, found):
    threaded = sweep(*clouds, COUNTS, model="similarity2d", threads=2)
    assert threaded.rows() == [
        row | {"time_s": other["time_s"]}
        for row, other in zip(found.rows(), threaded.rows(), strict=True)
    ]


def test_gap_tolerance_holds_for_every_cardinality(clouds):
    given = dcreg.sweep(*clouds, [16, 20, 24], model="similarity2d", rel_gap=0.0, abs_gap=0.01)
    assert [result.gap_tol for result in given.results] == [pytest.approx(0.01)] * 3
    assert all(result.gap <= result.gap_tol for result in given.results)


def test_3d_sweep_runs_both_stages():
    settings = {"model": "rigid3d", "rel_gap": 0.0, "abs_gap": 0.0005, "mode": "paper"}
    swept = sweep(*solid(), [16, 20, 22, 24], **settings)
    assert swept.status is Status.OPTIMAL
    for result in swept.results:
        times = [event.time_s for event in result.trace]
        assert times == sorted(times)  # all stages read the same clock
        assert "rotation" in {event.stage for event in result.trace}
        alone = register(*solid(), n_inliers=result.n_inliers, **settings)
        assert result.certificate_scope == alone.certificate_scope
        assert result.lower_bound <= alone.upper_bound + 1e-12
        assert alone.lower_bound <= result.upper_bound + 1e-12
        assert result.upper_bound <= alone.upper_bound + result.gap_tol
        assert [stage.name for stage in result.stages][-2:] == ["rotation", "polish"]
        assert np.linalg.det(result.rotation) == pytest.approx(1.0)
    expected = Rotation.from_rotvec([0.4, 1.9, -0.8]).as_matrix()
    assert np.allclose(swept.results[1].rotation, expected, atol=0.1)


def test_default_mode_of_a_3d_sweep_is_that_of_register():
    """The pose that `register` finds, where norms alone would mislead: clutter on one side of each."""
    source, target = solid()
    settings = {"model": "rigid3d", "time_limit": 10.0}
    swept = dcreg.sweep(source, target, [20, 22], model="rigid3d", time_limit=20.0)
    for result in swept.results:
        alone = dcreg.register(source, target, n_inliers=result.n_inliers, **settings)
        assert (result.mode, result.certificate_scope) == (alone.mode, alone.certificate_scope)
        assert result.upper_bound == pytest.approx(alone.upper_bound, rel=0.05)
    turned = dcreg.sweep(target[:20], source, [16, 18], **settings)
    back = dcreg.sweep(source, target[:20], [16, 18], **settings)
    product = turned.results[1].T_target_source @ back.results[1].T_target_source
    np.testing.assert_allclose(product, np.eye(4), atol=0.2)


def half_of(pairs, n, m, seed=3):
    """A mask with `pairs` that (i, i) and half of all others."""
    mask = np.random.default_rng(seed).random((n, m)) < 0.5
    mask[:pairs, :pairs] |= np.eye(pairs, dtype=bool)
    return mask


def test_candidates_hold_for_every_cardinality(clouds):
    mask = half_of(18, 24, 24)
    found = dcreg.sweep(*clouds, [16, 18, 20, 22], model="similarity2d", candidates=mask)
    free = dcreg.sweep(*clouds, [16, 18, 20, 22], model="similarity2d")
    for mine, other in zip(found.results, free.results, strict=True):
        k = mine.n_inliers
        alone = dcreg.register(*clouds, n_inliers=k, model="similarity2d", candidates=mask)
        assert mine.status is Status.OPTIMAL
        assert mask[tuple(mine.assignment.T)].all()
        assert abs(mine.upper_bound - alone.upper_bound) <= mine.gap_tol
        assert mine.upper_bound >= other.lower_bound
    # two of the twenty true pairs are infeasible
    assert found.results[2].upper_bound > free.results[2].upper_bound


def test_candidates_hold_in_3d():
    clouds = solid(n_common=10, n_points=12)
    mask = half_of(10, 12, 12)
    found = dcreg.sweep(*clouds, [8, 10], model="rigid3d", candidates=mask)
    for result in found.results:
        assert result.status is Status.OPTIMAL
        assert mask[tuple(result.assignment.T)].all()


def test_too_few_candidates_are_refused_for_the_cardinality_that_lacks_them(clouds):
    mask = np.zeros((24, 24), bool)
    mask[:20, :20] = np.eye(20, dtype=bool)
    with pytest.raises(InputError, match=r"at most 20 pairs .* n_inliers = 22"):
        dcreg.sweep(*clouds, [18, 22], model="similarity2d", candidates=mask)


def test_plain_values_for_json(found):
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert content["status"] == "optimal"
    assert content["suggested_n_inliers"] == 20
    assert [row["n_inliers"] for row in content["table"]] == COUNTS
    assert [result["n_inliers"] for result in content["results"]] == COUNTS


def test_large_clouds_get_the_same_rotation_stage_as_a_single_call(monkeypatch):
    """Beyond a dense matrix the rotation is sampled, in a sweep as in `register`."""
    from dcreg.assignment import sparse

    monkeypatch.setattr(sparse, "DENSE_PAIRS", 100)
    source, target = solid(n_common=24, noise=0.01)
    swept = sweep(source, target, [24], model="rigid3d", mode="paper").results[0]
    alone = register(source, target, n_inliers=24, model="rigid3d", mode="paper")
    for result in (swept, alone):
        (turn,) = [stage for stage in result.stages if stage.name == "rotation"]
        assert turn.n_nodes == 0  # sampled, not searched
    np.testing.assert_allclose(swept.T_target_source, alone.T_target_source, atol=1e-6)


def test_polish_of_a_sweep_ends_with_its_time():
    """Past the limit a pose is evaluated and not polished, as in `register`."""
    clouds = flat(noise=0.05)
    results = dcreg.sweep(*clouds, [20, 22], model="similarity2d", time_limit=1e-9).results
    for result in results:
        (polished,) = [stage for stage in result.stages if stage.name == "polish"]
        assert polished.n_assignments == 0
        np.testing.assert_array_equal(result.T_target_source, result.T_certified)


def test_poses_are_not_exchanged_past_the_limit(monkeypatch):
    """Poses of neighbours are tried only before the limit; then each has one descent."""
    calls = []
    refine = Similarity2D.refine
    monkeypatch.setattr(
        Similarity2D, "refine", lambda space, theta: calls.append(space) or refine(space, theta)
    )
    dcreg.sweep(*flat(noise=0.05), COUNTS, model="similarity2d", time_limit=1e-9)
    starts = [space for space in calls if space.n_source == 24]  # not those of the warm-up
    assert 0 < len(starts) == len(set(map(id, starts)))


@pytest.mark.parametrize("time_limit", [1e-9, 0.5])
def test_a_pose_reaches_all_cardinalities_though_the_time_is_over(monkeypatch, time_limit):
    """One good initial pose is enough: no cardinality keeps a pose worse than its neighbour's."""
    start = Similarity2D.start

    def first_well(space, budget, enough, known):
        if space.n_source != 24:  # in the warm-up
            return start(space, budget, enough, known)
        if space.n_inliers == COUNTS[0]:
            clouds = space.source, space.clouds.target.T
            unlimited = Similarity2D(*clouds, space.n_inliers, space.scale_range)
            return start(unlimited, Budget(), enough, known)
        while not space.stop_flag[0]:  # until the end of all searches
            time.sleep(0.01)
        return space.identity, np.inf, 0

    monkeypatch.setattr(Similarity2D, "start", first_well)
    clouds = flat(noise=0.05)
    swept = dcreg.sweep(*clouds, COUNTS, model="similarity2d", time_limit=time_limit)
    first, *others = swept.results
    assert first.upper_bound < 0.1 * dcreg.objective(*clouds, np.eye(3), COUNTS[0])[0]
    for result in others:
        there, _ = dcreg.objective(*clouds, first.T_certified, result.n_inliers)
        assert result.upper_bound <= there * (1.0 + 1e-9)


def test_time_of_descents_is_counted(found):
    for result in found.results:
        assert result.stages[0].name == "local searches"
        assert 0.0 < result.stages[0].time_s <= result.time_solve_s


# --- in agreement with `register` ----------------------------------------------------------------


def test_every_cardinality_has_the_warnings_of_a_single_call(clouds):
    source, target = clouds
    larger = 12.0 * target  # beyond the range of scales
    settings = {"model": "similarity2d", "node_limit": 200}
    swept = dcreg.sweep(source, larger, [16, 20], **settings)
    for result in swept.results:
        alone = dcreg.register(source, larger, n_inliers=result.n_inliers, **settings)
        mine, its = ([line.split()[:4] for line in found.warnings] for found in (result, alone))
        assert mine == its
    (scale,) = [line for line in swept.warnings if "scale_range" in line]
    assert scale.startswith("the scale 1.5 is at the limit")  # stated once
    assert f"warning: {scale}" in str(swept)


def test_warnings_are_given_before_the_search(caplog):
    source, target = solid()
    with caplog.at_level("INFO", logger="dcreg"):
        dcreg.sweep(source, 10.0 * target, [20, 24], model="rigid3d", node_limit=1)
    assert [line for line in caplog.messages if "RMS radii differ" in line] == [
        *dcreg.advice(dcreg.Problem(source, 10.0 * target, 24, "rigid3d"))
    ]


def test_large_clouds_are_searched_by_a_sample_in_3d(monkeypatch):
    monkeypatch.setitem(LARGE_PAIRS, 3, 900)
    monkeypatch.setitem(LARGE_SAMPLE, 3, 25)
    monkeypatch.setattr(modes, "NORM_PAIRS", 900)
    generator = np.random.default_rng(0)
    source = generator.random((40, 3)) * [2.0, 1.0, 0.5]
    target = source[:, [1, 2, 0]] + 1.0
    options = {"model": "rigid3d", "time_limit": 6.0}
    part = dcreg.sweep(source, target, [30, 31, 32], **options)
    alone = dcreg.register(source, target, n_inliers=32, **options)
    assert [r.downsampled for r in part.results] == [(25, 25, 19), (25, 25, 19), (25, 25, 20)]
    assert [r.mode for r in part.results] == ["full"] * 3
    assert part.results[-1].downsampled == alone.downsampled
    for result in part.results:
        assert len(result.assignment) == result.n_inliers
        assert result.stages[-1].name == "all points"
        # the same on all points, which fit exactly
        np.testing.assert_allclose(result.T_target_source, alone.T_target_source, atol=1e-6)
    assert part.results[0].upper_bound == pytest.approx(part.results[1].upper_bound)
    assert set(part.proven_by) <= {None, 30, 31, 32}  # as they were asked for
    whole = dcreg.sweep(source, target, [40], **options)
    assert (whole.results[0].mode, whole.results[0].downsampled) == ("full", (25, 25, 25))
    asked = sweep(source, target, [30], **options, mode="full", downsample=20)
    assert asked.results[0].downsampled == (20, 20, 15)


def test_a_rotation_search_leaves_time_for_all_points(rng):
    source = rng.random((300, 3)) * [2.0, 1.0, 0.5]
    target = source + 3.0 + 0.01 * rng.standard_normal(source.shape)
    swept = sweep(
        source, target, [200, 210], model="rigid3d", rel_gap=0.0, abs_gap=0.0, time_limit=2.0,
        mode="paper", downsample=60, prove=True,
    )  # fmt: skip
    assert swept.status is Status.TIME_LIMIT
    for result in swept.results:
        last = result.stages[-1]
        assert last.name == "all points"
        assert last.n_assignments > 1
        assert last.objective_after < last.objective_before


def test_a_sweep_over_samples_stops_without_a_proof_and_suggests_a_number(rng):
    """Otherwise the searches use the time that all points need."""
    source = rng.random((400, 3)) * [2.0, 1.0, 0.5]
    target = source + 3.0 + 0.01 * rng.standard_normal(source.shape)
    target[280:] = rng.random((120, 3)) * [2.0, 1.0, 0.5] + 3.0
    counts, limit = [200, 240, 280, 320, 360], 60.0
    options = {"model": "rigid3d", "rel_gap": 0.0, "abs_gap": 0.0, "time_limit": limit}
    swept = sweep(source, target, counts, **options, mode="full", downsample=80)
    assert {result.status for result in swept.results} == {Status.CONVERGED}
    assert sum(result.time_solve_s for result in swept.results) < 0.7 * limit
    assert swept.suggested_n_inliers == 280
    np.testing.assert_allclose(swept.results[2].translation, [3.0] * 3, atol=0.02)


def test_a_sample_of_a_sweep_refuses_what_it_would_ignore(clouds):
    with pytest.raises(InputError, match="downsample: candidates would not be used"):
        sweep(*clouds, [18], model="similarity2d", candidates=half_of(18, 24, 24), downsample=10)


def test_descents_of_all_cardinalities_share_the_time(monkeypatch):
    begun = []

    def until_its_end(space, budget, enough, known):
        if space.n_source == 24:  # not in the warm-up
            begun.append((space.n_inliers, budget.is_over))
            while not budget.is_over:
                time.sleep(0.01)
        return space.identity, space.objective(space.identity)[0], 1

    monkeypatch.setattr(Similarity2D, "start", until_its_end)
    dcreg.sweep(*flat(noise=0.05), [16, 18, 20], model="similarity2d", time_limit=2.0)
    assert begun == [(16, False), (18, False), (20, False)]


def test_a_cardinality_without_any_time_has_a_pose():
    source, target = np.random.default_rng(0).random((2, 1000, 3))
    found = sweep(source, target, [0.5, 0.7, 0.9], model="rigid3d", time_limit=0.05, mode="full")
    assert found.status is Status.TIME_LIMIT
    for result in found.results:
        assert np.linalg.det(result.rotation) == pytest.approx(1.0)
        assert len(result.assignment) == result.n_inliers
