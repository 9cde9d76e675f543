"""Similarities in 3D: right poses, certified small problems, refused settings, the command line."""

import json
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.problem.geometry import fit_pose
from tests.problems import register
from tests.results import run

MODEL = "similarity3d"


def planted(seed, n, noise=0.01, outliers=0, scale=None):
    """A cloud, its moved and shuffled copy, and the pose; the last points of both are outliers."""
    rng = np.random.default_rng(seed)
    source = rng.standard_normal((n, 3))
    T = np.eye(4)
    scale = rng.uniform(0.55, 1.45) if scale is None else scale
    T[:3, :3] = scale * Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = rng.standard_normal(3)
    target = source @ T[:3, :3].T + T[:3, 3] + noise * rng.standard_normal((n, 3))
    if outliers:
        source[-outliers:] = rng.standard_normal((outliers, 3))
        target[-outliers:] = rng.standard_normal((outliers, 3)) * scale + T[:3, 3]
    return source, target[rng.permutation(n)], T


def error(found, T, source):
    """The root mean square displacement between two poses."""
    gaps = source @ (found[:3, :3] - T[:3, :3]).T + found[:3, 3] - T[:3, 3]
    return np.sqrt((gaps**2).sum(axis=1).mean())


@pytest.mark.parametrize(("n", "noise", "outliers"), [(10, 0.02, 0), (30, 0.02, 0), (10, 0.01, 2)])
@pytest.mark.parametrize("seed", range(3))
def test_small_problems_are_certified(seed, n, noise, outliers):
    source, target, T = planted(seed, n, noise, outliers)
    found = dcreg.register(source, target, n_inliers=n - outliers, model=MODEL)
    assert found.status is dcreg.Status.OPTIMAL
    assert found.certificate_scope == "similarity pose"
    assert error(found.T_target_source, T, source) < 0.05
    assert found.lower_bound >= 0.989 * found.upper_bound


def test_exact_copy_of_another_size_is_found():
    source, target, T = planted(0, 40, noise=0.0, scale=2.5)
    found = dcreg.register(source, target, n_inliers=40, model=MODEL, scale_range=(2.0, 3.0))
    assert found.is_exact
    assert found.scale == pytest.approx(2.5)
    assert found.T_target_source == pytest.approx(T, abs=1e-6)


def test_pose_of_clouds_with_outliers_is_found():
    source, target, T = planted(1, 60, outliers=15)
    found = dcreg.register(source, target, n_inliers=45, model=MODEL, time_limit=10)
    assert found.status in (dcreg.Status.OPTIMAL, dcreg.Status.CONVERGED)
    assert error(found.T_target_source, T, source) < 0.05


def test_large_clouds_are_sampled():
    source, target, T = planted(2, 1500, noise=0.005)
    found = dcreg.register(source, target, n_inliers=1500, model=MODEL, time_limit=20)
    assert found.downsampled is not None
    assert error(found.T_target_source, T, source) < 0.02
    assert 0.5 <= found.scale <= 1.5


@pytest.mark.parametrize("outliers", [0, 2])
def test_fixed_scale_gives_the_rigid_pose(outliers):
    source, target, _ = planted(3, 12, outliers=outliers, scale=1.0)
    given = {"n_inliers": 12 - outliers, "rel_gap": 1e-4}
    rigid = dcreg.register(source, target, model="rigid3d", **given)
    found = dcreg.register(source, target, model=MODEL, scale_range=(1.0, 1.0), **given)
    assert found.scale == pytest.approx(1.0)
    assert found.objective == pytest.approx(rigid.objective)
    assert found.T_target_source == pytest.approx(rigid.T_target_source, abs=1e-6)


def test_scale_at_the_end_of_its_range_is_certified_and_noted():
    source, target, _ = planted(4, 12, scale=1.0)
    found = dcreg.register(source, target, n_inliers=12, model=MODEL, scale_range=(0.5, 0.9))
    assert found.status is dcreg.Status.OPTIMAL
    assert found.scale == pytest.approx(0.9)
    assert any("scale_range" in line for line in found.warnings)
    pairs = found.assignment
    T = fit_pose(source[pairs[:, 0]], target[pairs[:, 1]], (0.5, 0.9))
    assert found.T_target_source == pytest.approx(T, abs=1e-6)


def test_candidates_and_an_initial_guess_are_used():
    source, target, T = planted(5, 12)
    moved = source @ T[:3, :3].T + T[:3, 3]
    near = np.linalg.norm(moved[:, None] - target[None], axis=2) < 1.0
    found = register(
        source, target, n_inliers=10, model=MODEL, candidates=near, init=T, node_limit=500
    )
    assert near[tuple(found.assignment.T)].all()
    assert error(found.T_target_source, T, source) < 0.05


def test_covariance_covers_the_free_scale():
    source, target, _ = planted(6, 30)
    found = dcreg.register(source, target, n_inliers=30, model=MODEL)
    assert found.covariance.shape == (7, 7)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0
    fixed = dcreg.register(source, target, n_inliers=30, model=MODEL, scale_range=(1, 1))
    assert fixed.covariance.shape == (6, 6)


def test_standard_deviation_of_the_scale_matches_repeated_noise():
    rng = np.random.default_rng(0)
    source = rng.standard_normal((50, 3))
    logs, stated = [], []
    for _ in range(60):
        target = source + 0.05 * rng.standard_normal((50, 3))
        T = fit_pose(source, target, (0.5, 1.5))
        logs.append(np.log(dcreg.problem.scale_of(T)))
        covariance = dcreg.problem.pose_covariance(T, source, target, has_scale=True)
        stated.append(covariance[6, 6])
    assert np.var(logs) == pytest.approx(np.mean(stated), rel=0.5)


def test_certify_and_sweep_work():
    source, target, T = planted(7, 12, outliers=2)
    judged = dcreg.certify(source, target, T, n_inliers=10, model=MODEL)
    assert judged.verdict != "improvable" or judged.result.objective < judged.objective
    found = dcreg.sweep(source, target, [8, 10], model=MODEL, time_limit=10)
    assert len(found.results) == 2
    assert error(found.results[-1].T_target_source, T, source) < 0.05


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"pose_range": dcreg.PoseRange(max_angle=30)},
            "pose_range: not supported by similarity3d",
        ),
        (
            {"certificate": True},
            "certificate: mode 'full' of similarity3d makes none; use rigid3d, or omit certificate",
        ),
        ({"bound": "tight"}, "leave the bound out$"),
        ({"mode": "paper"}, "mode: 'paper' is unknown for similarity3d"),
        ({"scale_range": (2.0, 1.0)}, "scale_range"),
    ],
)
def test_settings_that_it_lacks_are_refused(given, message):
    source, target, _ = planted(8, 6)
    with pytest.raises(dcreg.InputError, match=message):
        register(source, target, n_inliers=6, model=MODEL, **given)


def test_alternatives_are_refused_with_a_remedy():
    source, target, _ = planted(8, 6)
    with pytest.raises(dcreg.InputError, match="similarity3d has no search for alternatives; use"):
        dcreg.alternatives(source, target, n_inliers=6, model=MODEL)


def test_rigid3d_names_the_model_that_has_a_scale():
    source, target, T = planted(8, 6, scale=1.3)
    with pytest.raises(dcreg.InputError, match="similarity3d"):
        dcreg.register(source, target, n_inliers=6, model="rigid3d", scale_range=(0.5, 1.5))
    with pytest.raises(dcreg.InputError, match="similarity3d"):
        dcreg.certify(source, target, T, n_inliers=6, model="rigid3d")


def test_command_line_registers_and_moves_the_source(tmp_path):
    source, target, T = planted(9, 12)
    files = [str(tmp_path / name) for name in ("a.txt", "b.txt")]
    for file, points in zip(files, (source, target), strict=True):
        np.savetxt(file, points)
    out, moved, pose = (tmp_path / name for name in ("found.json", "moved.txt", "pose.txt"))
    given = ["--model", MODEL, "--n-inliers", "12"]
    outcome = run("register", *files, *given, "--json", out, "--output", moved)
    assert outcome.exit_code == 0, outcome.output
    found = json.loads(out.read_text())
    assert found["status"] == "optimal"
    found = np.array(found["T_target_source"])
    assert error(found, T, source) < 0.05
    expected = source @ found[:3, :3].T + found[:3, 3]
    assert np.loadtxt(moved) == pytest.approx(expected, abs=1e-4)
    np.savetxt(pose, found)
    outcome = run("certify", pose, *files, *given)
    assert outcome.exit_code == 0, outcome.output


def test_searches_of_other_models_do_not_load_it():
    for model, dim in (("similarity2d", 2), ("rigid3d", 3)):
        code = (
            "import sys, numpy, dcreg\n"
            f"p = numpy.random.default_rng(0).random((6, {dim}))\n"
            f"dcreg.register(p, p, n_inliers=5, model='{model}')\n"
            "print(*[name for name in sys.modules if 'similarity3d' in name])"
        )
        loaded = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        names = loaded.stdout.split()
        assert not {name for name in names if not name.endswith(("similarity3d", "_full"))}
