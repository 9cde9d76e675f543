"""The command line with real searches."""

import json
import sys

import numpy as np
import pytest

import dcreg
from tests.results import run


def test_real_registration_2d(cloud_files, tmp_path):
    outcome = run(
        *("register", *cloud_files, "--model", "similarity2d", "--n-inliers", "1.0"),
        *("--json", tmp_path / "o.json", "--trace", tmp_path / "o.jsonl"),
        *("--plot", tmp_path / "o.html"),
    )
    assert outcome.exit_code == 0, outcome.output
    content = json.loads((tmp_path / "o.json").read_text())
    assert content["status"] == "optimal"
    assert content["scale"] == pytest.approx(1.2, abs=1e-6)
    T = np.array(content["T_target_source"])
    np.testing.assert_allclose(T[:2, 2], [5.0, -2.0], atol=1e-6)  # in the files' coordinates
    assert sorted(content["assignment"]) == [[i, i] for i in range(12)]
    assert content["gap"] <= content["gap_tol"]
    last = json.loads((tmp_path / "o.jsonl").read_text().splitlines()[-1])
    assert (last["kind"], last["status"]) == ("end", "optimal")


def test_real_registration_3d(tmp_path):
    from scipy.spatial.transform import Rotation

    source = np.random.default_rng(5).normal(size=(15, 3)) * [0.6, 0.4, 0.2]
    turn = Rotation.from_euler("xyz", [20, 40, 60], degrees=True).as_matrix()
    np.savetxt(tmp_path / "a.xyz", source)
    np.savetxt(tmp_path / "b.csv", source @ turn.T + [1.0, 2.0, 3.0], delimiter=",")
    outcome = run(
        *("register", tmp_path / "a.xyz", tmp_path / "b.csv", "--model", "rigid3d"),
        *("--n-inliers", "15", "--json", tmp_path / "o.json", "--plot", tmp_path / "o.html"),
    )
    assert outcome.exit_code == 0, outcome.output
    content = json.loads((tmp_path / "o.json").read_text())
    assert content["certificate_scope"] == "rigid pose"  # all points match: mode full
    T = np.array(content["T_target_source"])
    np.testing.assert_allclose(T[:3, :3], turn, atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], [1.0, 2.0, 3.0], atol=1e-6)


def test_real_limit_exits_3_with_a_pose(tmp_path):
    generator = np.random.default_rng(8)
    for name in ("a.txt", "b.txt"):
        np.savetxt(tmp_path / name, generator.random((60, 2)))
    outcome = run(
        *("register", tmp_path / "a.txt", tmp_path / "b.txt", "--model", "similarity2d"),
        *(
            "--n-inliers",
            "0.5",
            "--abs-gap",
            "0",
            "--node-limit",
            "40",
            "--json",
            tmp_path / "o.json",
        ),
    )
    assert outcome.exit_code == 3
    content = json.loads((tmp_path / "o.json").read_text())
    assert content["status"] == "node_limit"
    assert np.isfinite(content["T_target_source"]).all()


@pytest.mark.parametrize("mode", ["auto", "full", "paper"])
def test_candidates_hold_in_every_3d_mode(mode, tmp_path):
    source = np.random.default_rng(3).random((8, 3))
    np.savetxt(tmp_path / "source.txt", source)
    np.savetxt(tmp_path / "target.txt", source[::-1] + 1.0)
    pairs = [[i, j] for i in range(8) for j in {i, 7 - i}]
    np.savetxt(tmp_path / "pairs.txt", pairs, fmt="%d")
    outcome = run(
        *("register", tmp_path / "source.txt", tmp_path / "target.txt", "--model", "rigid3d"),
        *("--n-inliers", 8, "--mode", mode, "--candidates", tmp_path / "pairs.txt"),
        *("--json", "-", "--quiet"),
    )
    assert outcome.exit_code == 0, outcome.stderr
    found = json.loads(outcome.stdout)
    assert found["mode"] == ("full" if mode == "auto" else mode)
    assert found["assignment"] == [[i, 7 - i] for i in range(8)]


def test_written_certificate_is_verified_and_a_damaged_one_refused(tmp_path):
    points = np.random.default_rng(5).random((12, 2))
    np.savetxt(tmp_path / "a.txt", points)
    np.savetxt(tmp_path / "b.txt", points + 0.01 * np.random.default_rng(6).random((12, 2)) + 3.0)
    a, b, proof = (str(tmp_path / name) for name in ("a.txt", "b.txt", "proof.npz"))
    arguments = ["register", a, b, "--model", "similarity2d", "--n-inliers", "12"]
    for tolerance, said in ((["--tol", "0.01"], "true, but proves nothing:"), ([], "proven:")):
        made = run(*arguments, *tolerance, "--certificate", proof)
        assert made.exit_code == 0
        accepted = run("verify", proof, a, b)
        assert accepted.exit_code == 0
        assert said in accepted.output
    page = tmp_path / "page.html"
    stated = run("verify", proof, a, b, "--json", "-", "--plot", page, "--quiet")
    assert stated.exit_code == 0, stated.stderr
    values = json.loads(stated.stdout)
    assert (values["verdict"], values["source"], values["certificate"]) == ("proven", a, proof)
    assert 0.0 < values["lower_bound"] <= values["upper_bound"]
    assert values["statement"] in page.read_text("utf-8")
    assert len(values["checks"]) == stated.stderr.count("ok: ")
    refused = run("verify", proof, b, a, "--json", tmp_path / "no.json", "--plot", page)
    assert refused.exit_code == 5
    assert "rejected:" in refused.output
    assert json.loads((tmp_path / "no.json").read_text())["verdict"] == "rejected"
    assert "source: differs" in page.read_text("utf-8")
    whole = (tmp_path / "proof.npz").read_bytes()
    (tmp_path / "proof.npz").write_bytes(whole[: len(whole) // 2])
    assert run("verify", proof, a, b).exit_code == 5
    assert run("verify", tmp_path / "none.npz", a, b).exit_code == 2


def test_sweep_for_real(sweep_call, tmp_path):
    outcome = run(
        *(*sweep_call, "--out", tmp_path / "a.csv", "--plot", tmp_path / "a.svg", "--quiet")
    )
    assert outcome.exit_code == 0, outcome.output
    assert outcome.stderr == ""
    table = [line.split() for line in outcome.stdout.splitlines()]
    assert [cells[0] for cells in table[1:4]] == ["6", "9", "12"]
    assert "suggestion" in outcome.stdout
    lines = (tmp_path / "a.csv").read_text().splitlines()
    header = lines[0].split(",")
    last = dict(zip(header, lines[3].split(","), strict=True))
    assert (last["n_inliers"], last["status"], last["marginal_cost"]) == ("12", "optimal", "")
    pose = [[float(last[f"T{i}{j}"]) for j in range(3)] for i in range(3)]
    expected = [1.2 * np.cos(0.4), -1.2 * np.sin(0.4), 5.0]
    np.testing.assert_allclose(pose[0], expected, atol=1e-6)
    assert (tmp_path / "a.svg").read_text().lstrip().startswith("<?xml")


def test_default_tolerance_of_a_target_without_extent(tmp_path):
    """The source then gives the unit of length, so that the default tolerance is not zero."""
    source = np.random.default_rng(3).random((6, 2))
    target = np.ones((6, 2))
    np.savetxt(tmp_path / "a.txt", source)
    np.savetxt(tmp_path / "b.txt", target)
    outcome = run(
        *("register", tmp_path / "a.txt", tmp_path / "b.txt", "--model", "similarity2d"),
        *("--n-inliers", "6", "--json", tmp_path / "o.json"),
    )
    assert outcome.exit_code == 0, outcome.output
    tolerance = json.loads((tmp_path / "o.json").read_text())["gap_tol"]
    expected = dcreg.register(source, target, n_inliers=6, model="similarity2d").gap_tol
    assert tolerance == pytest.approx(expected)
    assert tolerance > 0


def test_equal_ends_of_the_scale_range_fix_the_scale(cloud_files, tmp_path):
    command = ["register", *cloud_files, "--model", "similarity2d", "--n-inliers", "12"]
    outcome = run(*command, "--scale-range", 1, 1, "--json", tmp_path / "o.json")
    assert outcome.exit_code == 0, outcome.output
    content = json.loads((tmp_path / "o.json").read_text())
    assert content["status"] == "optimal"
    assert content["scale"] == pytest.approx(1.0, abs=1e-12)  # 1.2 without the constraint
    assert content["objective"] > 0.01


@pytest.mark.parametrize(("more", "pairs"), [([], 9), (["--downsample", "5"], 4)])
def test_a_tolerance_as_a_length(call, more, pairs):
    """It refers to the pairs that are searched."""
    found = json.loads(run(*call, "--rel-gap", "0", "--tol", "0.1", "--json", "-", *more).stdout)
    assert found["gap_tol"] == pytest.approx(pairs * 0.01)


def test_hints_refer_to_what_is_searched(tmp_path, monkeypatch):
    """Hints about large clouds (unless downsampled) and units, and none with --quiet."""
    monkeypatch.setattr(sys.modules["dcreg.diagnostics"], "_VERY_MANY_POINTS", 40)
    cloud = np.random.default_rng(0).random((45, 3))
    np.save(tmp_path / "a.npy", cloud)
    np.save(tmp_path / "b.npy", 1000 * cloud[:30])
    arguments = ["register", tmp_path / "a.npy", tmp_path / "b.npy", "--model", "rigid3d"]
    arguments += ["--n-inliers", "20", "--time-limit", "0.5"]
    whole = run(*arguments).stderr
    assert "45 x 30 points is slow" in whole
    assert "--downsample 200" in whole
    assert "hint: the RMS radii differ a lot" in whole
    some = run(*arguments, "--downsample", "15").stderr
    assert "45 x 30 points is slow" not in some
    assert "hint: the RMS radii differ a lot" in some
    assert run(*arguments, "--quiet").stderr == ""


def test_no_hint_without_reason(call):
    outcome = run(*call)
    assert "hint" not in outcome.stderr
    assert "points is slow" not in outcome.stderr


def test_weights_come_from_files(cloud_files, tmp_path):
    call = ["register", *cloud_files, "--model", "similarity2d", "--json", tmp_path / "o.json"]
    target = np.load(cloud_files[1].removesuffix(":a"))["a"]
    target[0] += 0.5
    np.save(tmp_path / "moved.npy", target)
    call[2] = tmp_path / "moved.npy"
    (tmp_path / "w.txt").write_text("# confidence\n" + "1e-6\n" + 11 * "1\n")
    weights = ("--source-weights", tmp_path / "w.txt")
    outcome = run(*call, *weights, "--n-inliers", "1.0")
    assert outcome.exit_code == 0, outcome.output
    content = json.loads((tmp_path / "o.json").read_text())
    assert content["certificate_scope"] == "similarity pose, weighted points"
    assert content["scale"] == pytest.approx(1.2, abs=1e-4)
    assert content["objective"] < 1e-5
    outcome = run(*call, *weights, "--n-inliers", "0.8")
    assert outcome.exit_code == 2
    assert "--weight-distance" in outcome.output
    outcome = run(*call, *weights, "--n-inliers", "0.8", "--weight-distance", "0.1")
    assert outcome.exit_code == 0, outcome.output
    outcome = run(*call, "--n-inliers", "0.8", "--weight-distance", "0.1")
    assert outcome.exit_code == 2
    assert "there are no weights" in outcome.output


def test_weights_of_dropped_points_are_left_out(tmp_path):
    points = np.random.default_rng(3).random((10, 2))
    np.savetxt(tmp_path / "b.txt", points[1:] + 2.0)
    points[0] = np.nan
    np.savetxt(tmp_path / "a.txt", points)
    call = (
        *("register", tmp_path / "a.txt", tmp_path / "b.txt", "--model", "similarity2d"),
        *("--n-inliers", "9", "--drop-invalid", "--source-weights", tmp_path / "w.txt"),
    )
    np.savetxt(tmp_path / "w.txt", np.arange(10.0))  # that of the dropped point is invalid
    assert run(*call).exit_code == 0
    np.savetxt(tmp_path / "w.txt", np.arange(1.0, 10.0))
    outcome = run(*call)
    assert outcome.exit_code == 2
    assert "9 numbers for 10 points" in outcome.output


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1\n2 3\n", "line 2 has 2 values, expected 1"),
        ("1\nheavy\n", "line 2: 'heavy' is not a number"),
        ("", "give one number per point"),
    ],
)
def test_bad_weight_files_are_refused(content, message, tmp_path):
    (tmp_path / "w.txt").write_text(content)
    with pytest.raises(dcreg.InputError, match=message):
        dcreg.read_weights(tmp_path / "w.txt")
    with pytest.raises(
        dcreg.InputError, match=r"unknown extension '.ply'; use one of: .txt .csv .npy"
    ):
        dcreg.read_weights(tmp_path / "w.ply")
