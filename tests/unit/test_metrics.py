"""Metrics against values known by construction."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import workflows.metrics
from data.contract import DataError
from data.sampling import reference_pose
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.names import NORM_SCOPES, POSE_SCOPES
from dcreg.problem import apply_pose
from workflows.discovery import modules
from workflows.instances import Problem, Truth
from workflows.metrics import METRICS, Case
from workflows.metrics.errors import rotation_error_deg
from workflows.records import runs_columns
from workflows.stages import generate
from workflows.stages.evaluate import judge, relate
from workflows.stages.plan import InstanceSpec


def similarity(angle_deg: float, scale: float, shift: tuple[float, float]) -> np.ndarray:
    T = np.eye(3)
    angle = np.radians(angle_deg)
    T[:2, :2] = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    T[:2, 2] = shift
    return T


def case(T: np.ndarray, T_true: np.ndarray, rng, n: int = 8, outliers: int = 3, **more) -> Case:
    """A noise-free case whose last points are outliers on both sides."""
    d = len(T) - 1
    inliers = rng.random((n, d))
    source = np.vstack([inliers, 5 + rng.random((outliers, d))])
    target = np.vstack([inliers @ T_true[:d, :d].T + T_true[:d, d], -5 - rng.random((outliers, d))])
    rows = np.arange(n)
    scale_range = (0.0, np.inf) if d == 2 else (1.0, 1.0)
    fields = {"n_inliers": n, "scale_range": scale_range, **more}
    return Case(T, T_true, source, target, np.column_stack([rows, rows]), **fields)


def values(judged: Case) -> dict[str, float]:
    return {name: metric.compute(judged) for name, metric in METRICS.items() if metric.compute}


def test_the_true_pose_is_perfect_whatever_the_outliers(rng):
    T = similarity(200, 1.3, (0.2, -0.1))
    found = values(case(T, T, rng))
    for name in ("rmse", "rmse_over_scale", "rotation_error_deg", "translation_error"):
        assert found[name] == pytest.approx(0, abs=1e-7)
    assert found["objective"] == pytest.approx(0, abs=1e-12)
    assert found["success"]


def test_a_shift_gives_exactly_its_length(rng):
    T_true = similarity(30, 2.0, (0, 0))
    found = values(case(similarity(30, 2.0, (0.3, 0.4)), T_true, rng))
    assert found["rmse"] == pytest.approx(0.5)
    assert found["rmse_over_scale"] == pytest.approx(0.25)
    assert found["translation_error"] == pytest.approx(0.5)
    assert found["rotation_error_deg"] == pytest.approx(0, abs=1e-9)
    assert found["scale_error"] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("angle", [0.001, 1, 90, 179, 180])
def test_rotation_error_in_both_dimensions(rng, angle):
    flat = case(similarity(20 + angle, 0.7, (0, 0)), similarity(20, 1.2, (0, 0)), rng)
    assert rotation_error_deg(flat) == pytest.approx(angle, rel=1e-6)
    start = Rotation.random(rng=rng)
    axis = Rotation.random(rng=rng).apply([0, 0, 1])
    T, T_true = np.eye(4), np.eye(4)
    T_true[:3, :3] = start.as_matrix()
    T[:3, :3] = (Rotation.from_rotvec(np.radians(angle) * axis) * start).as_matrix()
    assert rotation_error_deg(case(T, T_true, rng)) == pytest.approx(angle, rel=1e-6)


def test_scale_error_is_relative(rng):
    found = values(case(similarity(0, 1.5, (0, 0)), similarity(0, 1.0, (0, 0)), rng))
    assert found["scale_error"] == pytest.approx(0.5)


def test_success_is_relative_to_the_inliers_but_metric_for_3dmatch(rng):
    T_true = np.eye(3)
    near = similarity(0, 1, (0.15, 0))  # 0.15 of a target about 1 long
    assert not METRICS["success"].compute(case(near, T_true, rng))
    assert METRICS["success"].compute(case(near, T_true, rng, success_limits={"rmse": 0.2}))


@pytest.mark.parametrize("share", [0.04, 0.06])
def test_success_on_shapes_does_not_depend_on_their_rotation(rng, share):
    for angle in (0, 30, 45):
        T_true = similarity(angle, 0.8, (0, 0))
        near = similarity(angle, 0.8, (0.8 * share, 0))
        found = METRICS["success"].compute(case(near, T_true, rng, shape_length=0.8))
        assert found == (share < 0.05)


def test_objective_takes_the_best_pairs_at_the_pose(rng):
    shift = similarity(0, 1, (0.01, 0))
    judged = case(shift, np.eye(3), rng, n_inliers=5)
    assert judged.objective <= 5 * 0.01**2 + 1e-12
    assert judged.objective_true == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("scope", [*POSE_SCOPES, *NORM_SCOPES])
def test_a_bound_above_what_the_truth_attains_is_a_violation(rng, scope):
    T, violation = np.eye(3), METRICS["bound_violation"].compute
    above = case(T, T, rng, lower_bound=0.1, scope=scope)
    assert violation(above) == pytest.approx(0.1)
    assert violation(case(T, T, rng, lower_bound=0.0, scope=scope)) == 0


def test_scopes_are_those_of_the_library():
    assert set(POSE_SCOPES) == {Similarity2D.scope, Rigid3D.scope}
    assert set(NORM_SCOPES) == {Translation3D.scope}


@pytest.mark.parametrize(
    "changes",
    [
        {"scope": "rotation about the translation found in norm space"},
        {"scope": ""},
        {"lower_bound": np.nan},
        {"is_downsampled": True},
    ],
)
def test_a_bound_on_something_else_is_not_compared_with_the_objective(rng, changes):
    given = {"lower_bound": 0.1, "scope": "similarity pose"} | changes
    assert np.isnan(METRICS["bound_violation"].compute(case(np.eye(3), np.eye(3), rng, **given)))


def test_the_objective_is_left_out_where_the_method_saw_fewer_points(rng):
    found = values(case(np.eye(3), np.eye(3), rng, is_downsampled=True))
    assert np.isnan(found["objective"])
    assert np.isnan(found["objective_true"])
    assert found["success"]


def test_the_floor_is_below_every_pose(rng):
    exact = case(np.eye(4), np.eye(4), rng)
    noisy = replace(exact, target=exact.target + 0.05 * rng.standard_normal((11, 3)))
    assert 0 < noisy.rmse_floor <= noisy.rmse


def deformed(rng, T_found: np.ndarray, success_limits: dict | None = None) -> Case:
    """A pose where the true pairs are so deformed that no similarity reaches an RMSE of 0.1."""
    points, rows = rng.random((40, 2)), np.arange(40)
    bent = points + 0.2 * rng.standard_normal((40, 2))
    pairs = np.column_stack([rows, rows])
    best = reference_pose(points, bent, pairs, (0.5, 1.5))
    return Case(T_found @ best, best, points, bent, pairs, 40, (0.5, 1.5), success_limits or {})


def test_success_does_not_punish_the_deformation_itself(rng):
    at_best = deformed(rng, np.eye(3))
    assert at_best.rmse == pytest.approx(at_best.rmse_floor)
    assert at_best.rmse > 0.1
    assert at_best.rmse_excess == pytest.approx(0, abs=1e-7)
    assert METRICS["success"].compute(at_best)
    near, far = (deformed(rng, similarity(0, 1, (shift, 0))) for shift in (0.02, 0.2))
    assert near.rmse_excess == pytest.approx(0.02)
    assert far.rmse_excess == pytest.approx(0.2)
    assert METRICS["success"].compute(near)
    assert not METRICS["success"].compute(far)


def test_a_published_threshold_is_kept_without_the_floor(rng):
    assert not METRICS["success"].compute(deformed(rng, np.eye(3), {"rmse": 0.2}))


def test_poses_outside_the_given_range_are_not_admissible(rng):
    def allowed(T, scale_range):
        return METRICS["admissible"].compute(case(T, T, rng, scale_range=scale_range))

    T = similarity(40, 1.5, (0, 0))
    assert allowed(T, (0.5, 1.5))
    assert not allowed(T, (0.5, 1.4))
    assert not allowed(np.diag([1.2, 0.9, 1.0]), (0.5, 1.5))  # no similarity
    assert not allowed(np.diag([1.0, -1.0, 1.0]), (0.5, 1.5))  # a reflection
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(rng=rng).as_matrix()
    assert allowed(turn, (1.0, 1.0))


def test_the_floor_is_that_of_rigid_poses_in_3d_and_of_similarities_in_2d(rng):
    def floor(dim, linear):
        points, pairs = rng.random((6, dim)), np.column_stack([np.arange(6), np.arange(6)])
        T, scales = np.eye(dim + 1), (1.0, 1.0) if dim == 3 else (0.5, 1.5)
        judged = Case(T, T, points, points @ linear.T + 3.0, pairs, 6, scales)
        return judged.rmse_floor

    turn = Rotation.random(rng=rng).as_matrix()
    assert floor(3, turn) < 1e-12
    assert floor(3, 1.2 * turn) > 0.01
    assert floor(2, 1.2 * np.array([[0.6, -0.8], [0.8, 0.6]])) < 1e-12
    assert floor(2, np.diag([1.0, -1.0])) > 0.01  # no reflection
    assert floor(2, 1.8 * np.eye(2)) > 0.01  # the scale stays in the given range


RUN = {
    "run_id": "r", "instance_id": "i", "n_inliers": 8, "lower_bound": np.nan, "n_source": 8,
    "n_target": 8, "certificate_scope": "", "T_target_source": "",
}  # fmt: skip


def test_a_run_without_pose_has_no_metrics_and_no_success(rng):
    judged = case(np.eye(3), np.eye(3), rng)
    problem = Problem("i", "similarity2d", judged.source, judged.target, (0.5, 1.5), 8, 0.1)
    run = RUN | {"n_source": 11, "n_target": 11}
    row = judge(run, problem, Truth("i", np.eye(3), judged.pairs))
    assert np.isnan(row["rmse"])
    assert row["success"] is False
    assert row["admissible"] is False
    assert row["noise_bound"] == 0.1
    assert json.loads(row["T_reference"]) == np.eye(3).tolist()
    assert row["objective_true"] == pytest.approx(0, abs=1e-12)  # known without any pose


def test_the_cube_of_translations_of_a_method_may_exclude_the_truth(rng):
    source = rng.random((12, 3))
    T_true = np.eye(4)
    T_true[:3, 3] = [0.1, -0.2, 0.3]
    target = np.vstack([apply_pose(T_true, source), 30.0 + rng.random((4, 3))])
    problem = Problem("i", "rigid3d", source, target, (1.0, 1.0), 12, 0.1)
    spec = InstanceSpec("horse", "horse", "noise", 0.5, 3, None, "rigid3d")
    truth = Truth("i", T_true, np.column_stack([np.arange(12)] * 2))
    run = RUN | {"n_inliers": 12, "n_source": 12, "n_target": 16}
    options = [{"translation_half_width": half} for half in (None, 0.01)]
    found = [judge(run, problem, truth, None, each)["truth_in_cube"] for each in (*options, {})]
    assert found[:2] == [1.0, 0.0]
    assert np.isnan(found[2])
    flat = Problem("i", "similarity2d", source[:, :2], target[:, :2], (1.0, 1.0), 12, 0.1)
    of_flat = judge(run, flat, Truth("i", np.eye(3), truth.pairs), None, options[0])
    assert np.isnan(of_flat["truth_in_cube"])  # the method does not support it
    generate.check_cube(spec, problem, T_true)
    T_true[0, 3] = 1e3
    with pytest.raises(DataError, match=r"horse horse noise 0\.5, trial 3: the cube of transl"):
        generate.check_cube(spec, problem, T_true)


def test_a_run_is_evaluated_by_the_marks_and_the_given_range(rng):
    source = rng.random((8, 2))
    problem = Problem("i", "similarity2d", source, source, (0.5, 0.9), 8, 0.1)
    run = RUN | {"T_target_source": json.dumps(np.eye(3).tolist())}
    rows = np.column_stack([np.arange(8)] * 2)
    marks = np.hstack([source, source + np.array([0.3, 0.4])])
    row = judge(run, problem, Truth("i", np.eye(3), rows, marks))
    assert row["rmse"] == pytest.approx(0.5)
    assert row["admissible"] is False
    truth = Truth("i", np.eye(3), rows)
    whole = judge(run, problem, truth)
    assert (whole["rmse"], whole["objective"]) == (0.0, 0.0)
    thinned = judge(run | {"n_target": 7}, problem, truth)
    assert thinned["rmse"] == 0.0
    assert np.isnan(thinned["objective"])


def test_regret_is_against_every_known_admissible_pose_of_the_same_prior():
    columns = ["instance_id", "n_inliers", "objective", "objective_true", "admissible"]
    rows = [
        ("a", 5, 3.0, 2.0, True),
        ("a", 5, 1.0, 2.0, True),
        ("a", 2, 0.5, 0.1, True),
        ("b", 5, np.nan, 2.0, False),
        ("c", 5, 3.0, 4.0, True),
        ("c", 5, 1.0, 4.0, False),
    ]
    related = relate(pd.DataFrame(rows, columns=columns))
    assert list(related["objective_best"]) == [1.0, 1.0, 0.1, 2.0, 3.0, 3.0]
    expected = [2.0, 0.0, 0.4, np.nan, 0.0, np.nan]
    np.testing.assert_array_equal(related["objective_regret"], expected)


def test_every_metric_is_documented_and_has_a_worst_value():
    for name, metric in METRICS.items():
        assert metric.meaning
        assert metric.unit
        assert metric.better in ("lower", "higher", "none"), name


def test_a_metric_is_one_file_that_is_found(rng, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(
        "from workflows.metrics.case import metric\n\n"
        "@metric('target unit', 'lower', axis='maximum error')\n"
        "def maximum_error(case):\n"
        "    '''Maximum distance of the true pairs at the found pose.'''\n"
        "    return float(case.residuals.max())\n"
    )
    monkeypatch.setattr(workflows.metrics, "__path__", [*workflows.metrics.__path__, str(tmp_path)])
    monkeypatch.delitem(sys.modules, "workflows.metrics.mine", raising=False)
    try:
        modules(workflows.metrics)
        found = METRICS["maximum_error"]
        assert found.meaning == "Maximum distance of the true pairs at the found pose"
        moved = case(similarity(0, 1, (0.3, 0.4)), np.eye(3), rng)
        assert found.compute(moved) == pytest.approx(0.5)
        assert "maximum_error" in runs_columns()
    finally:
        METRICS.pop("maximum_error", None)
        sys.modules.pop("workflows.metrics.mine", None)
