"""Answers to questions about a pose: their words, files, errors, and the reader of poses."""

import importlib
import json
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.cli import commands
from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.solve import Setup
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.problem import Problem, apply_pose, largest_matching
from dcreg.problem.geometry import fit_pose, last_bits, rms_radius
from dcreg.questions import inliers, other_poses
from dcreg.questions.certify import _percent_above
from dcreg.questions.counting import CountBound
from dcreg.result_parts import Stage
from dcreg.search import Boxes, Budget, Interrupted
from dcreg.status import Status
from tests.results import run

RNG = np.random.default_rng(0)
SOURCE = RNG.standard_normal((20, 3)) * [1.0, 0.7, 0.4]
TURN = Rotation.from_rotvec([0.2, -0.4, 0.9]).as_matrix()
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = TURN, [1.0, -2.0, 0.5]
TARGET = SOURCE @ TURN.T + POSE[:3, 3] + 0.01 * RNG.standard_normal((20, 3))
KEYWORDS = {"n_inliers": 20, "model": "rigid3d"}


@pytest.fixture(scope="module")
def best():
    return dcreg.register(SOURCE, TARGET, **KEYWORDS)


# --- certify ---------------------------------------------------------------------------------------


def test_the_best_pose_is_certified_as_optimal(best):
    found = dcreg.certify(SOURCE, TARGET, best.T_target_source, **KEYWORDS)
    assert found.verdict == "optimal"
    assert found.max_improvement <= found.gap_tol * (1 + 1e-5)
    assert found.objective == pytest.approx(best.objective)


def test_a_rough_pose_is_improvable_by_the_distance_to_the_best(best):
    rough = POSE.copy()
    rough[:3, 3] += 0.1
    found = dcreg.certify(SOURCE, TARGET, rough, **KEYWORDS)
    assert found.verdict == "improvable"
    assert found.displacement == pytest.approx(0.1 * np.sqrt(3), rel=0.2)
    assert found.result.objective == pytest.approx(best.objective)


def test_a_pose_that_is_worse_than_the_given_one_is_not_the_best_known_one(best):
    """A limit can end the refinement of the pose of a sample before it reaches the given one."""
    rough = POSE.copy()
    rough[:3, 3] += 0.1
    found = dcreg.certify(SOURCE, TARGET, rough, **KEYWORDS)
    assert "best known pose" in dict(found.entries())
    worse = replace(found, verdict="open", objective=0.5 * best.objective)
    assert "best known pose" not in {*dict(worse.entries()), *worse.poses}


def test_an_exact_fit_attains_a_lower_bound_of_0():
    found = dcreg.certify(SOURCE, SOURCE @ TURN.T, np.eye(4), **KEYWORDS)
    assert found.verdict == "improvable"
    assert dict(found.entries())["lower bound"].endswith(": the best known pose is an exact fit")


def test_a_pose_is_open_if_there_is_no_time(best):
    found = dcreg.certify(SOURCE, TARGET, best.T_target_source, **KEYWORDS, node_limit=1)
    assert found.verdict == "open"
    assert found.lower_bound < found.objective - found.gap_tol


def test_the_last_digits_of_a_pose_may_be_missing():
    rounded = np.round(POSE, 5)
    pose_range = dcreg.PoseRange(axis=(0, 0, 1), max_angle=10, around=POSE)
    found = dcreg.certify(SOURCE, TARGET, rounded, **KEYWORDS, pose_range=pose_range)
    assert np.allclose(found.T_target_source, POSE, atol=1e-4)
    pose = np.round(np.array([[0.6, -0.8, 1.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]) * 1.00001, 5)
    pose[2, 2] = 1.0
    source = SOURCE[:, :2]
    found = dcreg.certify(
        source, source @ pose[:2, :2].T, pose, n_inliers=10, model="similarity2d",
        scale_range=(1, 1), node_limit=1,
    )  # fmt: skip
    linear = found.T_target_source[:2, :2]
    assert abs(np.linalg.det(pose[:2, :2]) - 1.0) > 1e-6
    assert np.linalg.det(linear) == pytest.approx(1.0, abs=1e-12)
    assert linear == pytest.approx(pose[:2, :2], abs=1e-4)


def test_the_time_of_certify_is_that_of_a_search(best):
    found = dcreg.certify(SOURCE, TARGET, best.T_target_source, **KEYWORDS)
    assert found.result.n_nodes <= best.n_nodes
    assert found.result.n_assignments <= 1.1 * best.n_assignments + 30


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.eye(3), r"pose: shape \(3, 3\)"),
        (2 * np.eye(4), "last row"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "is not a rotation"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "its scale is 2"),
        (np.full((4, 4), np.nan), "not finite"),
        ("text", "not a matrix of numbers"),
    ],
)
def test_what_is_no_pose_is_refused(pose, words):
    with pytest.raises(dcreg.InputError, match=words):
        dcreg.certify(SOURCE, TARGET, pose, **KEYWORDS)


def test_a_rigid_pose_with_a_scale_near_1_is_judged_without_it(best):
    rough = best.T_target_source.copy()
    rough[:3, :3] *= 0.9994  # as in official poses of 3DMatch
    found = dcreg.certify(SOURCE, TARGET, rough, **KEYWORDS)
    assert (found.verdict, found.objective) == ("optimal", pytest.approx(best.objective))


@pytest.mark.parametrize(
    ("options", "remedy"),
    [({"mode": "paper"}, "use mode 'full'"), ({"bound": "dc"}, "use mode 'full' and omit bound")],
)
def test_a_mode_without_poses_is_refused_without_settings_that_were_not_given(options, remedy):
    options, why = dcreg.SolveOptions(**options), "searches norms, not poses"
    with pytest.raises(dcreg.InputError, match=f"^mode: a given pose .* {why}; {remedy}$"):
        dcreg.certify(SOURCE, TARGET, POSE, **KEYWORDS, options=options)
    with pytest.raises(dcreg.InputError, match=f"^mode: a given residual .* {why}; {remedy}$"):
        dcreg.max_inliers(SOURCE, TARGET, distance=0.1, model="rigid3d", options=options)


def test_a_checkpoint_of_another_pose_is_refused_without_matrices(tmp_path):
    options = dcreg.SolveOptions(checkpoint=tmp_path / "state.npz")
    dcreg.certify(SOURCE, TARGET, POSE, **KEYWORDS, options=options)
    with pytest.raises(dcreg.InputError, match=r"from another pose; give the same [^\[]*$"):
        dcreg.certify(SOURCE, TARGET, np.eye(4), **KEYWORDS, options=options)


# --- alternatives ----------------------------------------------------------------------------------


def test_symmetric_shapes_have_all_their_poses():
    turns = 2 * np.pi * np.arange(5) / 5
    pentagon = np.column_stack([np.cos(turns), np.sin(turns)])
    found = dcreg.alternatives(
        pentagon, pentagon + 1.0, n_inliers=5, model="similarity2d", scale_range=(1, 1)
    )
    assert found.is_complete
    assert sorted(round(each.angle_deg) for each in found.others) == [72, 72, 144, 144]
    assert {each.fold for each in found.others} == {5}
    box = np.array([[a, b, c] for a in (0.0, 3.0) for b in (0.0, 2.0) for c in (0.0, 1.0)])
    found = dcreg.alternatives(box, box @ TURN.T, n_inliers=8, model="rigid3d")
    assert found.is_complete
    assert [round(each.angle_deg) for each in found.others] == [180, 180, 180]
    assert {each.fold for each in found.others} == {2}
    axes = np.array([each.axis for each in found.others]) @ TURN  # in coordinates of the box
    assert np.allclose(np.sort(np.abs(axes), axis=1), [0.0, 0.0, 1.0])
    assert "(a 2-fold turn)" in str(found)
    assert "times" not in dict(found.entries())["lower bound"]  # the best objective is 0


def test_a_turn_has_no_name_if_many_angles_are_as_close_to_one():
    """Unrelated points have poses of similar objectives, and a large default displacement."""
    source, target = np.random.default_rng(1).random((2, 6, 3))
    found = dcreg.alternatives(
        source, target, n_inliers=6, model="rigid3d", ratio=2.5, max_others=3
    )
    assert len(found.others) == 3
    assert all(each.fold is None for each in found.others)
    assert found.lower_bound == found.result.lower_bound > 0.0
    angle = dcreg.questions.alternatives.Alternative(np.eye(3), 0.0, 32.7, 1.0, fold=11)
    assert "(an 11-fold turn)" in angle.motion


def test_an_exact_pose_is_not_said_to_be_unproven():
    target = SOURCE + 1.0
    pose = np.eye(4)
    pose[:3, 3] = 1.0
    judged = dcreg.certify(SOURCE, target, pose, n_inliers=len(SOURCE), model="rigid3d")
    assert judged.is_exact
    assert dict(judged.entries())["lower bound"].endswith(": the fit is exact up to rounding")


def test_the_objective_of_weighted_points_is_no_residual():
    weights = dcreg.PointWeights(source=np.linspace(0.2, 1.0, 20), distance=1.0)
    judged = dcreg.certify(
        SOURCE, TARGET, POSE, n_inliers=12, model="rigid3d", weights=weights, time_limit=0.5
    )
    assert "residual" not in dict(judged.entries())["objective"]


def test_a_repeated_part_is_a_shift_without_axis_or_fold():
    """The target holds the source twice, at two places; the list is complete."""
    twice = np.concatenate([SOURCE[:8], np.array([3.0, 0.0, 0.0]) + SOURCE[:8]])
    found = dcreg.alternatives(
        SOURCE[:8], twice, n_inliers=8, model="rigid3d", min_displacement=0.3, time_limit=20
    )
    assert found.is_complete
    (shift,) = found.others
    assert shift.displacement == pytest.approx(3.0, rel=0.01)
    assert shift.angle_deg < 1.0
    assert shift.axis is shift.fold is None
    assert "about (" not in str(found).partition("best pose")[0]


CHIRAL = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.5], [0.0, 2.0]])
KITE = np.array([[0.0, 0.0], [2.0, 0.5], [2.0, -0.5], [3.0, 1.0], [3.0, -1.0]])


@pytest.mark.parametrize(("shape", "angles"), [(CHIRAL, []), (KITE, [180])])
def test_a_mirror_image_counts_if_a_motion_gives_it(shape, angles):
    """A mirror image of a flat shape is a half turn in 3D. In 2D it is one only of a symmetric shape."""
    flat = np.column_stack([shape, np.zeros(5)])
    found = dcreg.alternatives(flat, flat @ TURN.T, n_inliers=5, model="rigid3d", time_limit=20)
    assert found.is_complete
    assert [round(each.angle_deg) for each in found.others] == angles
    pair = np.concatenate([shape, shape * [1.0, -1.0] + [10.0, 0.0]])
    found = dcreg.alternatives(
        shape, pair, n_inliers=5, model="similarity2d", scale_range=(1, 1), time_limit=20
    )
    assert found.is_complete
    assert len(found.others) == len(angles)


def test_equally_good_poses_are_found_and_proven_to_be_all():
    """All four poses of a square have the same objective up to rounding, which is the least `abs_gap`."""
    square = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    given = {"n_inliers": 4, "model": "similarity2d", "scale_range": (1, 1), "ratio": 1.0}
    target = square + 0.02 * np.random.default_rng(1).standard_normal((4, 2))
    found = dcreg.alternatives(square, target, **given, time_limit=20)
    assert found.is_complete
    assert sorted(each.fold for each in found.others) == [2, 4, 4]
    isolated = dcreg.alternatives(square, target, **given, isolated=0.5)
    assert sorted(each.fold for each in isolated.others) == [2, 4, 4]
    wider = dcreg.alternatives(square, target, **given, abs_gap=0.001, min_displacement=0.3)
    assert wider.threshold == pytest.approx(wider.result.upper_bound + 0.001)


def test_an_isolated_pose_has_a_bound_far_above_the_threshold():
    """No bound exceeds the objective of a pose just beyond the displacement."""
    for target, least in ((TARGET, 10.0), (SOURCE @ TURN.T, 0.0)):
        found = dcreg.alternatives(SOURCE, target, **KEYWORDS, isolated=0.5, noise=0.03)
        best = found.result
        assert found.is_unique
        assert found.min_displacement == 0.5
        assert found.threshold == pytest.approx(max(1.5 * best.upper_bound, 20 * 0.03**2))
        assert found.lower_bound > max(least * best.upper_bound, 20 * 0.1**2)
        moved = best.T_target_source.copy()
        moved[:3, 3] += 0.51 / np.sqrt(3.0)
        assert found.lower_bound < dcreg.objective(SOURCE, target, moved, 20)[0]
    assert "(RMS residual 0." in dict(found.entries())["lower bound"]


def test_more_target_points_in_2d_do_not_limit_the_bound_of_an_isolated_pose():
    """The bounds hold for all poses there, so the bound may exceed what follows from stationary ones."""
    generator = np.random.default_rng(0)
    target = generator.random((11, 2))
    source = target[:8] + 0.01 * generator.standard_normal((8, 2))
    found = dcreg.alternatives(
        source, target, n_inliers=8, model="similarity2d", isolated=0.15, time_limit=20
    )
    assert found.is_complete
    assert found.lower_bound > found.result.upper_bound + 8 * 0.15**2 / 4
    scales, turns = generator.uniform(0.5, 1.5, 3000), generator.uniform(0.0, 2.0 * np.pi, 3000)
    poses = np.tile(np.eye(3), (3000, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = scales * np.cos(turns)
    poses[:, 1, 0] = scales * np.sin(turns)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, :2, 2] = target.mean(axis=0) - poses[:, :2, :2] @ source.mean(axis=0)
    poses[:, :2, 2] += 0.2 * generator.standard_normal((3000, 2))
    best = apply_pose(found.result.T_target_source, source)
    far = [T for T in poses if np.sqrt(((apply_pose(T, source) - best) ** 2).sum(1).mean()) > 0.15]
    assert len(far) > 1000
    least = min(dcreg.objective(source, target, T, 8)[0] for T in far)
    assert found.lower_bound <= least


def test_poses_within_the_noise_are_listed():
    """The second copy is a little deformed: within the noise of 0.1, but not within that of 0.02."""
    source = SOURCE[:8, :2]
    other = source + 5.0 + 0.05 * np.random.default_rng(2).standard_normal((8, 2))
    given = {"n_inliers": 8, "model": "similarity2d", "scale_range": (1, 1), "time_limit": 20}
    for noise, count in ((0.1, 1), (0.02, 0)):
        found = dcreg.alternatives(source, np.concatenate([source, other]), **given, noise=noise)
        assert found.is_complete
        assert len(found.others) == count
        assert found.min_displacement >= 3 * noise


def test_poses_are_distinct_beyond_the_displacement_given():
    """Turns by 72 degrees displace the points by 1.18: between once and twice 0.7."""
    turns = 2 * np.pi * np.arange(5) / 5
    pentagon = np.column_stack([np.cos(turns), np.sin(turns)])
    found = dcreg.alternatives(
        pentagon, pentagon, n_inliers=5, model="similarity2d", scale_range=(1, 1),
        min_displacement=0.7, time_limit=20,
    )  # fmt: skip
    assert found.is_complete
    assert sorted(round(each.angle_deg) for each in found.others) == [72, 72, 144, 144]


def test_a_shape_without_symmetry_has_one_pose():
    found = dcreg.alternatives(SOURCE, TARGET, **KEYWORDS)
    assert found.is_unique
    assert found.lower_bound >= 1.5 * found.result.upper_bound
    words, _, ratio = dict(found.entries())["lower bound"].partition("; ")
    assert found.lower_bound * (1.0 - 1e-5) <= float(words.split()[0]) <= found.lower_bound
    assert float(ratio.split()[0]) >= 1.5


def test_printed_bounds_are_rounded_down_and_refer_to_all_listed_poses(best):
    bound = 20 * 0.0871298**2
    refuted = replace(best, status=Status.REFUTED, lower_bound=bound, max_rms=0.05)
    assert "proven: it is at least 0.08712\n" in refuted.summary()
    found = dcreg.Alternatives(Status.OPTIMAL, best, 0.1, 0.1, bound, [], 1.0)
    shown = dict(found.entries())["lower bound"]
    assert shown.startswith(
        "0.151832 (RMS residual 0.08712) for every pose that is distinct from all listed ones; "
    )


def test_a_line_has_more_poses_than_are_listed():
    line = np.outer(np.linspace(-1, 1, 6), [1.0, 0.0, 0.0])
    found = dcreg.alternatives(line, line, n_inliers=6, model="rigid3d", max_others=1)
    assert len(found.others) == 1
    assert not found.is_complete
    assert "stopped at the given number" in found.answer


def test_the_limit_that_ended_a_search_is_named():
    rng = np.random.default_rng(3)
    found = dcreg.alternatives(
        rng.random((14, 3)), rng.random((14, 3)), n_inliers=10, model="rigid3d", node_limit=200
    )
    assert found.status == "node_limit"


def test_an_exact_fit_meets_every_residual_and_a_refuted_one_stays_refuted():
    points = np.random.default_rng(0).integers(0, 8, (10, 3)) / 8.0
    met = dcreg.register(points, points + 2.0, n_inliers=10, model="rigid3d", max_rms=1e-17)
    assert met.status in ("optimal", "converged")
    near = points + 2.0 + 1e-4 * RNG.standard_normal(points.shape)
    refuted = dcreg.register(points, near, n_inliers=10, model="rigid3d", max_rms=1e-6)
    assert refuted.status == "refuted"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"ratio": 0.5}, "ratio: 0.5 is not a usable value; give a number of at least 1$"),
        ({"min_displacement": -1.0}, "min_displacement"),
        ({"min_displacement": 1e-12}, "min_displacement: 1e-12 .*; give a number of at least"),
        ({"isolated": 1e-12}, "isolated: 1e-12 .*; give a number of at least"),
        (
            {"isolated": 0.1, "min_displacement": 0.1},
            "isolated: replaces min_displacement; omit one",
        ),
        ({"noise": 0.0}, "noise: 0.0 is not a usable value"),
        ({"options": dcreg.SolveOptions(downsample=10)}, "a sample"),
        ({"max_others": 0}, "max_others"),
        (
            {"options": dcreg.SolveOptions(mode="paper")},
            "alternatives: mode 'paper' searches norms",
        ),
        ({"options": dcreg.SolveOptions(certificate=True)}, "certificate"),
    ],
)
def test_settings_that_alternatives_would_ignore_are_refused(given, words):
    with pytest.raises(dcreg.InputError, match=words):
        dcreg.alternatives(SOURCE, TARGET, **KEYWORDS, **given)


def test_messages_about_large_clouds_name_no_mode():
    cloud = np.random.default_rng(0).random((2001, 3))
    given = {"n_inliers": 0.5, "model": "rigid3d"}
    words = "2,001 x 2,001 points are too many .*; give fewer points, such as keypoints"
    with pytest.raises(dcreg.InputError, match=words):
        dcreg.register(cloud, cloud, max_rms=0.1, **given)
    options = dcreg.SolveOptions(downsample=3000, init=np.eye(4))
    words = r"source, target: a given pose .* 2,001 x .*; search a smaller sample"
    with pytest.raises(dcreg.InputError, match=words):
        dcreg.register(cloud, cloud, options=options, **given)
    words = "alternatives: 2,001 x 2,001 points .*; give fewer points, such as keypoints"
    with pytest.raises(dcreg.InputError, match=words):
        dcreg.alternatives(cloud, cloud, options=dcreg.SolveOptions(downsample=3000), **given)


# --- a residual to decide, a range, an initial guess -----------------------------------------------


def test_a_residual_is_met_or_refuted(best):
    for factor, status in ((0.97, "refuted"), (1.03, "converged")):
        found = dcreg.register(
            SOURCE, TARGET, max_rms=factor * best.rmse_matched, **KEYWORDS,
            options=dcreg.SolveOptions(prove=True),
        )  # fmt: skip
        assert found.status == status
        assert found.warnings == [] or status == "converged"
    assert found.reason == "a pose within max_rms was found"
    assert not [warning for warning in found.warnings if "nothing is proven" in warning]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"max_rms": 0.0}, "max_rms"),
        ({"max_rms": 0.1, "options": dcreg.SolveOptions(mode="paper")}, "searches norms"),
        ({"max_rms": 0.1, "options": dcreg.SolveOptions(downsample=10)}, "downsample"),
        (
            {"options": dcreg.SolveOptions(init=np.eye(4), mode="paper")},
            "mode: a given pose .* mode 'paper' searches norms, not poses; use mode 'full'$",
        ),
        ({"options": dcreg.SolveOptions(init=np.eye(3))}, "init: shape"),
        ({"pose_range": dcreg.PoseRange(axis=(0, 0, 0))}, "axis: all zero"),
        ({"pose_range": dcreg.PoseRange(axis="z")}, "axis"),
        ({"pose_range": dcreg.PoseRange(max_angle=-1)}, "max_angle"),
        ({"pose_range": dcreg.PoseRange(max_angle=181)}, "max_angle"),
        ({"pose_range": dcreg.PoseRange(max_translation=np.nan)}, "max_translation"),
        ({"pose_range": dcreg.PoseRange(max_angle=0, max_translation=0)}, "only one pose"),
        ({"pose_range": dcreg.PoseRange(pivot=(0, 0))}, "pivot"),
        ({"pose_range": "z"}, "not a PoseRange"),
        ({"pose_range": dcreg.PoseRange(max_angle=9), "options": dcreg.SolveOptions(mode="paper")},
         "pose_range: mode 'paper' searches all rotations; use mode 'full'$"),
        ({"pose_range": dcreg.PoseRange(max_angle=9), "options": dcreg.SolveOptions(bound="dc")},
         "does not accept 'dc'; leave the bound out$"),
    ],
)  # fmt: skip
def test_bad_settings_are_refused(given, words):
    with pytest.raises(dcreg.InputError, match=words):
        dcreg.register(SOURCE, TARGET, **KEYWORDS, **given)


def test_an_axis_is_for_three_dimensions():
    with pytest.raises(dcreg.InputError, match="axis: only rigid3d"):
        dcreg.register(
            SOURCE[:, :2], TARGET[:, :2], n_inliers=5, model="similarity2d",
            pose_range=dcreg.PoseRange(axis=(0, 0, 1)),
        )  # fmt: skip


@pytest.mark.parametrize("extra", [0, 15])
def test_an_initial_guess_does_not_change_the_answer(best, extra):
    """Whatever the guess: a good one, a wrong one, with the smaller cloud on either side."""
    target = np.vstack([TARGET, RNG.standard_normal((extra, 3))])
    for init in (POSE, np.eye(4)):
        options = dcreg.SolveOptions(init=init)
        found = dcreg.register(SOURCE, target, **KEYWORDS, options=options)
        assert found.objective == pytest.approx(best.objective, rel=0.02)
        inverse = dcreg.register(
            target, SOURCE, **KEYWORDS, options=dcreg.SolveOptions(init=np.linalg.inv(init))
        )
        assert inverse.objective == pytest.approx(best.objective, rel=0.02)


def test_a_sweep_begins_with_a_guess(best):
    events = []
    options = dcreg.SolveOptions(init=best.T_target_source, listener=events.append)
    found = dcreg.sweep(SOURCE, TARGET, [19, 20], model="rigid3d", options=options)
    assert found.results[1].objective == pytest.approx(best.objective)
    first = next(event.upper_bound for event in events if event.stage == "start of k=20")
    assert first == pytest.approx(best.upper_bound, rel=1e-6)


def test_no_event_has_the_objective_of_a_pose_outside_the_range():
    rng = np.random.default_rng(2)
    source = rng.standard_normal((12, 3))
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(45)]).as_matrix()
    target = source @ turn.T + 0.05 * rng.standard_normal(source.shape)
    found = dcreg.register(
        source, target, n_inliers=10, model="rigid3d", pose_range=dcreg.PoseRange(max_angle=40),
        time_limit=1,
    )  # fmt: skip
    assert min(event.upper_bound for event in found.trace) >= found.upper_bound * (1 - 1e-9)


def test_a_good_guess_is_the_first_upper_bound(best):
    options = dcreg.SolveOptions(init=best.T_target_source)
    found = dcreg.register(SOURCE, TARGET, **KEYWORDS, options=options)
    assert found.trace.events[0].upper_bound == pytest.approx(best.upper_bound, rel=1e-6)


def test_a_search_of_all_poses_that_hits_its_limit_proves_nothing():
    """The shape is symmetric, so the pose outside the range is as good as the one inside."""
    grid = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [0.0, 1.0], [1.0, 0.0], [2.0, 1.0]])
    target = -grid + 0.05 * np.random.default_rng(2).standard_normal(grid.shape)
    found = dcreg.register(
        grid, target, n_inliers=6, model="similarity2d", scale_range=(1, 1), rel_gap=0.5,
        pose_range=dcreg.PoseRange(max_angle=40), node_limit=1,
    )  # fmt: skip
    assert found.stages[0].name == "all poses"
    assert found.status == "node_limit"
    assert found.lower_bound < 0.5 * found.upper_bound


@pytest.mark.parametrize("angle", [90.0, 20.0])
def test_ranges_hold_for_samples_and_all_points(angle):
    rng = np.random.default_rng(1)
    source = rng.standard_normal((400, 3)) * [1.0, 0.6, 0.3]
    target = source @ TURN.T + 0.01 * rng.standard_normal(source.shape)
    pose_range = dcreg.PoseRange(max_angle=angle, max_translation=0.1)
    found = dcreg.register(
        source, target, n_inliers=0.9, model="rigid3d", pose_range=pose_range, time_limit=10,
        options=dcreg.SolveOptions(downsample=60),
    )  # fmt: skip
    assert pose_range.checked(source, (1.0, 1.0)).contains(found.T_target_source)
    right = Rotation.from_matrix(found.rotation @ TURN.T).magnitude() < 0.05
    assert right == (angle == 90.0)


def test_feasible_pairs_are_refuted_even_if_no_time_is_left_for_a_pose(monkeypatch):
    def no_time(self, budget):
        raise Interrupted

    monkeypatch.setattr(Rigid3D, "starts", no_time)
    found = dcreg.register(
        SOURCE, 3.0 * SOURCE, n_inliers=10, model="rigid3d", candidates=np.eye(20, dtype=bool),
        max_rms=0.01,
    )  # fmt: skip
    assert found.status is Status.REFUTED
    assert found.stages[0].name == "feasible pairs"


def test_largest_number_of_pairs_is_bracketed():
    target = np.vstack([TARGET[:14], 3.0 + RNG.standard_normal((6, 3))])
    found = dcreg.max_inliers(SOURCE, target, distance=0.05, model="rigid3d", time_limit=20)
    assert found.at_least >= 14
    assert found.at_most < found.n_possible == 20
    assert str(found.at_least) in found.answer


@pytest.mark.parametrize(
    ("at_most", "says"), [(19, "is proven"), (20, "no smaller number was proven")]
)
def test_a_number_of_points_is_not_called_a_proof(at_most, says):
    answer = dcreg.MaxInliers(0.1, 12, at_most, 20, np.eye(4), np.empty((12, 2), int), [], 1.0)
    assert answer.answer.startswith(f"12 to {at_most} pairs within 0.1")
    assert says in answer.answer
    tried = [(2, "refuted"), (1, "optimal")]
    searches = dict(replace(answer, tried=tried).entries())["searches"]
    assert searches == "2 pairs: refuted, 1 pair: optimal"


def test_the_time_that_is_left_lowers_the_upper_end(monkeypatch):
    """Numbers that their share of the time did not decide are searched again with the rest."""
    solved, asked = inliers.register_problem, []

    def slow(problem, limits, options):
        asked.append(problem.n_inliers)
        found = solved(problem, limits, options)
        is_first = asked.count(problem.n_inliers) == 1
        return replace(found, status=Status.TIME_LIMIT) if is_first else found

    monkeypatch.setattr(inliers, "register_problem", slow)
    monkeypatch.setattr(inliers, "has_count_search", lambda *_: False)  # as for similarity3d
    target = np.vstack([TARGET[:14], 3.0 + RNG.standard_normal((6, 3))])
    found = dcreg.max_inliers(SOURCE, target, distance=0.05, model="rigid3d", time_limit=60)
    assert asked[:2] == [20, 20]
    assert found.tried[:2] == [(20, "time_limit"), (20, "refuted")]
    assert found.at_least <= found.at_most < 20


def test_the_time_limit_of_the_largest_number_excludes_preparation(monkeypatch):
    solved, waited_s = inliers.register_problem, 1.0

    def compiling(problem, limits, options):
        time.sleep(waited_s)
        found = solved(problem, limits, options)
        return replace(found, time_setup_s=found.time_setup_s + waited_s)

    monkeypatch.setattr(inliers, "register_problem", compiling)
    target = np.vstack([TARGET[:15], RNG.standard_normal((5, 3)) + 5.0])
    found = dcreg.max_inliers(SOURCE, target, distance=0.05, model="rigid3d", time_limit=waited_s)
    assert len(found.tried) > 1
    assert found.time_s < waited_s * len(found.tried)


PLANTED = {
    "all poses": None,
    "range": dcreg.PoseRange(max_angle=120.0, max_translation=3.0),
    "axis": dcreg.PoseRange(axis=(0, 0, 1)),
}


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
@pytest.mark.parametrize("where", PLANTED)
def test_the_largest_number_of_pairs_is_proven(model, where):
    """Nine true pairs among clutter, within three times the noise."""
    rng, d = np.random.default_rng(3), int(model[-2])
    pose_range = PLANTED[where] if d == 3 or where != "axis" else dcreg.PoseRange(max_angle=0.0)
    source, target = rng.random((12, d)), rng.random((14, d)) + 0.5
    target[:9] = source[:9] + 0.5 + 0.01 * rng.uniform(-1.0, 1.0, (9, d))
    found = dcreg.max_inliers(
        source, target, distance=0.03, model=model, time_limit=20, pose_range=pose_range,
        scale_range=(0.8, 1.2) if d == 2 else None,
    )  # fmt: skip
    assert found.is_exact
    assert found.at_least >= 9
    assert (found.at_most + 1, "refuted") in found.tried


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
def test_bounds_on_numbers_of_pairs_hold_in_every_box(model):
    """No random pose of a box brings more pairs within the distance than its bound."""
    rng, d = np.random.default_rng(4), int(model[-2])
    source, target = rng.standard_normal((15, d)), rng.standard_normal((15, d))
    feasible = rng.random((15, 15)) < 0.7
    setup = Setup.of([Problem(source, target, 4, model, None, feasible)], Limits(), SolveOptions())
    bound = CountBound.of(setup, Budget(), 0.4, 15)
    space, tight = bound.space, 0
    for half in (0.01, 0.1, 0.5):
        roots = [bound.roots[at] for at in rng.integers(len(bound.roots), size=20)]
        centres = np.array([root.sample(rng, 1)[0] for root in roots])
        widths = half * np.array([root.half_widths > 0.0 for root in roots])
        boxes = Boxes(centres - widths, centres + widths)
        found = 15 - bound.evaluate(boxes, None).lower_bounds
        for lower, upper, most in zip(boxes.lower, boxes.upper, found, strict=True):
            thetas = rng.uniform(lower, upper, (20, len(lower)))
            for theta in thetas[space.admissible(thetas)]:
                moved = apply_pose(setup.frame.pose(space.pose(theta)), source)
                near = np.linalg.norm(moved[:, None] - target, axis=2) <= 0.4
                count = (largest_matching(near & feasible) >= 0).sum()
                assert count <= most
                tight += count == most
    assert tight > 20


@pytest.mark.parametrize("time_limit", [1e-9, 1.0])
def test_a_pose_without_pairs_is_in_its_range(time_limit):
    around = np.eye(4)
    around[:3, 3] = -50.0
    pose_range = dcreg.PoseRange(max_angle=10, max_translation=0.1, around=around)
    found = dcreg.max_inliers(
        SOURCE[:5], TARGET[:5] + 10.0, distance=0.1, model="rigid3d", pose_range=pose_range,
        time_limit=time_limit,
    )  # fmt: skip
    assert found.at_least == 0
    assert pose_range.checked(SOURCE[:5], (1.0, 1.0)).contains(found.T_target_source)


@pytest.mark.parametrize(("distance", "count"), [(0.21, 3), (0.19, 2)])
def test_pairs_are_bounded_close_to_the_distance(distance, count):
    """The best pose of two triangles has three residuals of 0.2."""
    turns = 2 * np.pi * np.arange(3) / 3
    triangle = np.column_stack([np.cos(turns), np.sin(turns)])
    found = dcreg.max_inliers(
        triangle, 1.2 * triangle, distance=distance, model="similarity2d", scale_range=(1, 1)
    )
    assert (found.at_least, found.at_most) == (count, count)


# --- the reader of poses ---------------------------------------------------------------------------


def test_poses_of_all_formats_are_the_same(tmp_path, best):
    quaternion = Rotation.from_matrix(TURN).as_quat()
    files = {
        "matrix.txt": "\n".join(" ".join(map(repr, row)) for row in POSE.tolist()),
        "commas.csv": "\n".join(",".join(map(repr, row)) for row in POSE.tolist()),
        "kitti.txt": " ".join(map(repr, POSE[:3].ravel().tolist())),
        "tum.txt": " ".join(map(repr, [12.5, *POSE[:3, 3].tolist(), *quaternion.tolist()])),
        "pose.json": json.dumps({"T_target_source": POSE.tolist()}),
    }
    for name, content in files.items():
        (tmp_path / name).write_text(content)
        assert np.allclose(dcreg.read_pose(tmp_path / name), POSE, atol=1e-12), name
    np.save(tmp_path / "pose.npy", POSE)
    assert np.allclose(dcreg.read_pose(tmp_path / "pose.npy"), POSE)
    best.write_json(tmp_path / "result.json")
    assert np.allclose(dcreg.read_pose(tmp_path / "result.json"), best.T_target_source)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("1 2 3", "3 numbers are not a pose"),
        ("1 0 0 x", "could not convert"),
        ("", "0 numbers"),
        ("{}", "JSON without a matrix"),
        ("{" * 5, "JSON without a matrix"),
        ("0 1 2 3 0 0 0 2", "quaternion"),
        ("1 0 0 0 1 0 0 1 1", "last row"),
        ("# time tx\n1 0 0 0 0 0 0 1\n2 0 0 1 0 0 0 1", "2 poses, .*; give a file with one line"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "3 poses, one per line"),
    ],
)
def test_what_holds_no_pose_is_refused_with_its_name(tmp_path, content, words):
    path = tmp_path / "pose.txt"
    path.write_text(content)
    with pytest.raises(dcreg.InputError, match=words) as error:
        dcreg.read_pose(path)
    assert "pose.txt" in str(error.value)


def test_a_scale_near_1_is_read_unchanged(tmp_path):
    pose = np.diag([1.00005, 1.00005, 1.00005, 1.0])
    np.savetxt(tmp_path / "pose.txt", pose)
    assert np.array_equal(dcreg.read_pose(tmp_path / "pose.txt"), pose)


def test_a_missing_pose_is_refused(tmp_path):
    with pytest.raises(dcreg.InputError, match="no such file"):
        dcreg.read_pose(tmp_path / "none.txt")


# --- command line ----------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path):
    for name, values in (("a.xyz", SOURCE), ("b.xyz", TARGET), ("pose.txt", POSE)):
        np.savetxt(tmp_path / name, values)
    return tmp_path


def test_questions_on_the_command_line(files):
    clouds = [str(files / "a.xyz"), str(files / "b.xyz"), "--model", "rigid3d", "--quiet"]
    pairs = ["--n-inliers", "20"]
    written = ["--json", str(files / "o.json"), "--plot", str(files / "o.html")]
    asked = {
        "certify": ([str(files / "pose.txt")], pairs, "improvable", 6, "verdict"),
        "alternatives": (["--isolated", "0.5", "--noise", "0.03"], pairs, "unique", 0, "is_unique"),
        "max-inliers": ([], ["--distance", "0.1"], "exactly 20 pairs", 0, "at_most"),
    }
    for command, (before, more, words, code, key) in asked.items():
        ran = run(command, *before, *clouds, *more, *written)
        assert ran.exit_code == code, ran.output
        assert words in ran.output
        assert key in json.loads((files / "o.json").read_text())
        assert "<html" in (files / "o.html").read_text()


def test_certify_and_sweep_have_the_files_of_register(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    points = np.random.default_rng(0).random((8, 2))
    pose = np.array([[1.0, 0, 3], [0, 1, 3], [0, 0, 1]])
    noise = 0.01 * np.random.default_rng(1).standard_normal((8, 2))
    values = {"a": points, "b": points + 3.0 + noise, "pose": pose, "w": np.arange(1.0, 9.0)}
    for name, array in values.items():
        np.savetxt(f"{name}.txt", array)
    clouds = "a.txt", "b.txt"
    options = "--model", "similarity2d", "--n-inliers", "1.0", "--quiet"
    ran = run("certify", "pose.txt", *clouds, *options, "--certificate", "c.npz")
    assert ran.exit_code in (0, 6), ran.output
    assert dcreg.verify("c.npz", points, values["b"]).accepted
    weights = "--source-weights", "w.txt"
    ran = run("certify", "pose.txt", *clouds, *options, *weights, "--json", "o.json")
    assert ran.exit_code in (0, 6), ran.output
    scope = json.loads(Path("o.json").read_text())["result"]["certificate_scope"]
    assert scope == "similarity pose, weighted points"
    ran = run("sweep", *clouds, *options, *weights, "--out", "o.json")
    assert ran.exit_code == 0, ran.output
    (result,) = json.loads(Path("o.json").read_text())["results"]
    assert result["certificate_scope"] == scope
    ran = run("certify", "pose.txt", *clouds, *options, "--certificate", "w.txt", *weights)
    assert "--certificate w.txt: is also an input" in ran.output


def test_ranges_are_options_of_all_searches(files):
    """The pose that fits is outside the range, except for one about the true axis."""
    clouds = [str(files / "a.xyz"), str(files / "b.xyz"), "--model", "rigid3d", "--quiet"]
    out, pairs = files / "o.json", ["--n-inliers", "20", "--node-limit", "50"]
    within = ["--distance", "0.05", "--time-limit", "0.5"]
    axis = ",".join(map(str, Rotation.from_matrix(TURN).as_rotvec()))
    for options, fits in (
        (["--axis", axis], True),
        (["--axis", "0,0,1", "--max-angle", "20"], False),
    ):
        ran = run("sweep", *clouds, *pairs, *options, "--out", str(out))
        assert ran.exit_code in (0, 3), ran.output
        (result,) = json.loads(out.read_text())["results"]
        assert (result["rmse_matched"] < 0.03) == fits
        ran = run("max-inliers", *clouds, *within, *options, "--json", str(out))
        assert ran.exit_code in (0, 3), ran.output
        assert (json.loads(out.read_text())["at_least"] == 20) == fits
        ran = run("certify", str(files / "pose.txt"), *clouds, *pairs, *options)
        assert ("not admitted by --axis" in ran.output) != fits, ran.output
    ran = run(
        "certify", str(files / "pose.txt"), *clouds, *pairs, "--init", str(files / "pose.txt")
    )
    assert "--init: certify begins with the pose that it judges" in ran.output


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--source-weights", "w.txt"], "--axis: cannot be combined with weights; omit --axis or"),
        (["--certificate", "c.npz"], "--certificate: `dcreg verify` .* --certificate or --axis$"),
        (["--max-angle", "9", "--mode", "paper"], "--axis and --max-angle: mode 'paper' searches"),
        (
            ["--max-angle", "9", "--checkpoint", "c.npz"],
            "omit --checkpoint, or --max-angle and --max-translation$",
        ),
        (["--max-angle", "9", "--model", "similarity3d"], "omit --axis and --max-angle, or"),
    ],
)
def test_messages_about_ranges_name_the_options_that_were_given(files, monkeypatch, options, words):
    monkeypatch.chdir(files)
    np.savetxt("w.txt", np.arange(1.0, 21.0))
    clouds = ["a.xyz", "b.xyz", "--model", "rigid3d", "--n-inliers", "20", "--quiet"]
    ran = run("register", *clouds, "--axis", "0,0,1", *options)
    assert ran.exit_code == 2
    assert re.search(words, ran.output.strip()), ran.output


def test_the_centre_of_a_range_is_refused_with_its_option(files):
    clouds = [str(files / "a.xyz"), str(files / "b.xyz"), "--model", "rigid3d"]
    np.savetxt(files / "plane.txt", np.eye(3))
    given = "--n-inliers", "20", "--max-angle", "9", "--init", str(files / "plane.txt")
    assert "error: --init: shape (3, 3)" in run("register", *clouds, *given).output


@pytest.mark.parametrize("option", ["--axis=0,0,1", "--max-angle=9", "--no-rotation"])
def test_a_search_of_all_poses_names_commands_that_have_a_range(files, option):
    clouds = [str(files / "a.xyz"), str(files / "b.xyz"), "--model", "rigid3d"]
    ran = run("alternatives", *clouds, "--n-inliers", "20", option)
    assert ran.exit_code == 2
    name = option.partition("=")[0]
    words = f"error: {name}: not an option of `dcreg alternatives`; omit {name}, or use `dcreg register`"
    assert words in ran.output


@pytest.mark.parametrize(
    ("option", "command"), [("--source-weights", "register"), ("--init=a.txt", "certify")]
)
def test_an_option_of_other_commands_is_refused_with_their_names(files, option, command):
    ran = run("alternatives", "a.xyz", "b.xyz", "--model", "rigid3d", option)
    assert ran.exit_code == 2
    name = option.partition("=")[0]
    assert (
        f"error: {name}: not an option of `dcreg alternatives`; omit {name}, or use" in ran.output
    )
    assert f"`dcreg {command}`" in ran.output


def test_a_refuted_residual_has_its_exit_code(files):
    ran = run(
        "register", str(files / "a.xyz"), str(files / "b.xyz"), "--model", "rigid3d",
        "--n-inliers", "20", "--max-rms", "0.001", "--quiet",
    )  # fmt: skip
    assert ran.exit_code == 6
    assert "refuted: no rigid pose matches 20 pairs" in ran.output


@pytest.mark.parametrize("tolerance", [(), ("--tol", "1")])
def test_a_residual_that_stays_open_has_the_exit_code_of_a_limit(files, monkeypatch, tolerance):
    """A tolerance above the residual found decides nothing."""
    solved = commands.run_search

    def gives_up(*arguments, **keywords):
        found = solved(*arguments, **keywords)
        stages = [Stage("rigid", 0.1, status=dcreg.Status.CONVERGED)]
        return replace(found, status=dcreg.Status.CONVERGED, lower_bound=0.0, stages=stages)

    monkeypatch.setattr(commands, "run_search", gives_up)
    ran = run(
        "register", str(files / "a.xyz"), str(files / "b.xyz"), "--model", "rigid3d",
        "--n-inliers", "20", "--max-rms", "0.001", "--quiet", *tolerance,
    )  # fmt: skip
    assert "proof not expected soon" in ran.output
    assert "answer           open: no pose was found that matches 20 pairs" in ran.output
    assert ran.exit_code == 3


@pytest.mark.parametrize("seed", [10, 46, 66, 104])
def test_an_attainable_residual_is_not_refuted_by_the_rounding_of_a_far_point(seed):
    """The fit to three of the points is the witness."""
    generator = np.random.default_rng(seed)
    far, noise = 10.0 ** generator.integers(3, 9), 10.0 ** generator.integers(-9, -4)
    target = generator.standard_normal((3, 3))
    near = target + 0.8 * noise * generator.standard_normal((3, 3))
    pose = fit_pose(near, target, (1.0, 1.0))
    rms = float(np.sqrt(((apply_pose(pose, near) - target) ** 2).sum(axis=1).mean()))
    status = [
        dcreg.register(
            np.vstack([near, np.full((1, 3), far)]), target, n_inliers=3, model="rigid3d",
            max_rms=factor * rms, node_limit=20_000, options=dcreg.SolveOptions(prove=True),
        ).status
        for factor in (1 + 1e-6, 0.5)
    ]  # fmt: skip
    assert status == [dcreg.Status.CONVERGED, dcreg.Status.REFUTED]


def test_other_questions_exclude_poses_only_beyond_the_rounding_of_the_coordinates(monkeypatch):
    """The clouds are far from the origin, so their last bits are large."""
    source = SOURCE + 1e6
    bits, tolerances, reaches = last_bits(source, TARGET), [], []
    unit = rms_radius(TARGET)
    kept = other_poses.Tolerance, CountBound.__init__

    def tolerance(**given):
        tolerances.append(given)
        return kept[0](**given)

    def count_bound(self, space, roots, threads, kernel, reach, most):
        reaches.append(reach)
        kept[1](self, space, roots, threads, kernel, reach, most)

    monkeypatch.setattr(other_poses, "Tolerance", tolerance)
    monkeypatch.setattr(CountBound, "__init__", count_bound)
    k = KEYWORDS["n_inliers"]
    dcreg.alternatives(source, TARGET, **KEYWORDS, node_limit=200)
    for given in tolerances:
        one_residual = 2.0 * np.sqrt(k * given["target"]) * bits / unit
        assert given["margin"] >= one_residual > 0.0
    assert tolerances
    dcreg.max_inliers(source, TARGET, distance=1e-9, model=KEYWORDS["model"], time_limit=2.0)
    assert min(reaches) * unit > 1e-9 + 0.99 * bits


@pytest.mark.parametrize(("max_rms", "status"), [(1.0, "converged"), (0.01, "time_limit")])
def test_a_residual_that_is_met_is_answered_at_a_limit(monkeypatch, max_rms, status):
    """The search for initial poses may take all the time and find a pose that is good enough."""
    module = importlib.import_module("dcreg.driver.solve")
    solved = module.run_mode

    def at_limit(*arguments, **keywords):
        found = solved(*arguments, **keywords)
        return replace(found, status=Status.TIME_LIMIT)

    monkeypatch.setattr(module, "run_mode", at_limit)
    found = dcreg.register(SOURCE, TARGET, **KEYWORDS, max_rms=max_rms)
    assert found.status.value == status


def test_what_may_be_gained_is_rounded_up():
    assert _percent_above(0.00993) == "1.0 %"
    assert _percent_above(0.5) == "50.0 %"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--no-rotation", "--axis", "0,0,1"], "--no-rotation: excludes"),
        (["--axis", "up"], "--axis: 'up' is not a direction"),
        (["--max-angle", "200"], "--max-angle: 200"),
        (["--init", "none.txt"], "no such file"),
    ],
)
@pytest.mark.parametrize("command", ["register", "sweep"])
def test_bad_ranges_on_the_command_line(files, command, options, words):
    ran = run(
        command, str(files / "a.xyz"), str(files / "b.xyz"), "--model", "rigid3d",
        "--n-inliers", "20", *options,
    )  # fmt: skip
    assert ran.exit_code == 2
    assert words in ran.output
