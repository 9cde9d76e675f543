"""``--output`` and ``--drop-invalid``: the moved source, and row numbers that refer to the files."""

import json
from functools import partial

import numpy as np
import pytest

import dcreg
from tests.results import run

# Rows of the files with points that are not finite.
BAD_SOURCE, BAD_TARGET = [0, 5, 6], [2]


@pytest.fixture
def clouds():
    """A 3D pair of 14 rows: row i of the source is row 13 - i of the target."""
    source = np.random.default_rng(5).random((14, 3))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    return source, (source @ turn.T + [1.0, 2, 3])[::-1].copy()


@pytest.fixture
def files(clouds, tmp_path):
    source, target = clouds
    source[BAD_SOURCE] = np.nan
    target[BAD_TARGET] = np.inf
    np.savetxt(tmp_path / "s.txt", source)
    np.save(tmp_path / "t.npy", target)
    return tmp_path / "s.txt", tmp_path / "t.npy"


@pytest.fixture
def call(files):
    return partial(run, "register", *files, "--model", "rigid3d", "--n-inliers", "9")


def assert_pairs_of_files(result):
    pairs = np.array(result["assignment"])
    assert (pairs.sum(axis=1) == 13).all()
    assert not set(pairs[:, 0]) & set(BAD_SOURCE)
    assert not set(pairs[:, 1]) & set(BAD_TARGET)
    assert (result["dropped_source"], result["dropped_target"]) == (3, 1)


# --- the moved source -------------------------------------------------------------------------------


def test_output_is_the_source_at_the_final_pose(clouds, tmp_path):
    source, target = clouds
    np.savez(tmp_path / "s.npz", a=source, b=source + 1)
    np.savetxt(tmp_path / "t.txt", target)
    outcome = run(
        *("register", f"{tmp_path / 's.npz'}:a", tmp_path / "t.txt", "--model", "rigid3d"),
        *("--n-inliers", "14", "--output", tmp_path / "moved.ply"),
    )
    assert outcome.exit_code == 0, outcome.output
    np.testing.assert_allclose(dcreg.read_points(tmp_path / "moved.ply"), target[::-1], atol=1e-9)


def test_output_of_matches(clouds, tmp_path):
    for name, cloud in zip("st", clouds, strict=True):
        np.savetxt(tmp_path / f"{name}.txt", cloud)
    np.savetxt(tmp_path / "m.txt", [(i, 13 - i) for i in range(14)], fmt="%d")
    outcome = run(
        "register-matches", *(tmp_path / f"{name}.txt" for name in "stm"),
        "--inlier-distance", "0.1", "--output", tmp_path / "moved.csv",
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.output
    np.testing.assert_allclose(
        dcreg.read_points(tmp_path / "moved.csv"), clouds[1][::-1], atol=1e-9
    )


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("moved.las", "the name must end in .ply or .pcd or .xyz"),
        ("moved", "the name must end in .ply"),
        ("s.txt", "is also an input"),
        ("absent/moved.ply", "create it first"),
    ],
)
def test_a_bad_output_stops_before_the_search(call, tmp_path, monkeypatch, name, words):
    monkeypatch.setattr(dcreg, "register", pytest.fail)
    outcome = call("--drop-invalid", "--output", tmp_path / name)
    assert outcome.exit_code == 2
    assert f"--output {tmp_path / name}" in outcome.stderr
    assert words in outcome.stderr


def test_the_archive_of_the_source_is_an_input(clouds, tmp_path):
    np.savez(tmp_path / "s.npz", a=clouds[0])
    np.save(tmp_path / "t.npy", clouds[1])
    outcome = run(
        *("register", f"{tmp_path / 's.npz'}:a", tmp_path / "t.npy", "--model", "rigid3d"),
        *("--n-inliers", "14", "--output", tmp_path / "s.npz"),
    )
    assert outcome.exit_code == 2
    assert "is also an input" in outcome.stderr


# --- invalid points -----------------------------------------------------------------------------------


def test_invalid_points_are_an_error_that_names_the_option(call):
    outcome = call()
    assert outcome.exit_code == 2
    assert "NaN or infinity in 3 of 14 points, first in line 1" in outcome.stderr
    assert "--drop-invalid" in outcome.stderr


def test_pairs_refer_to_the_rows_of_the_files(call, files, tmp_path):
    outputs = ("--json", tmp_path / "o.json", "--output", tmp_path / "o.txt")
    outcome = call("--drop-invalid", *outputs, "--plot", tmp_path / "o.html", "--quiet")
    assert outcome.exit_code == 0, outcome.output
    assert outcome.stderr.splitlines() == [
        f"warning: {files[0]}: 3 of 14 points hold NaN or infinity and are dropped",
        f"warning: {files[1]}: 1 of 14 points hold NaN or infinity and are dropped",
    ]
    result = json.loads((tmp_path / "o.json").read_text())
    assert_pairs_of_files(result)
    moved = dcreg.read_points(tmp_path / "o.txt", keep_invalid=True)
    assert np.flatnonzero(np.isnan(moved).any(axis=1)).tolist() == BAD_SOURCE
    i, j = np.array(result["assignment"]).T
    np.testing.assert_allclose(moved[i], np.load(files[1])[j], atol=1e-9)
    assert_pairs_of_files(json.loads(call("--drop-invalid", "--json", "-").stdout))


def test_nothing_is_added_without_the_option(clouds, tmp_path):
    for name, cloud in zip("st", clouds, strict=True):
        np.savetxt(tmp_path / f"{name}.txt", cloud)
    files = [tmp_path / f"{name}.txt" for name in "st"]
    command = ["register", *files, "--model", "rigid3d", "--n-inliers", "14", "--json", "-"]
    plain = json.loads(run(*command).stdout)
    dropped = json.loads(run(*command, "--drop-invalid").stdout)
    assert set(dropped) - set(plain) == {"dropped_source", "dropped_target"}
    assert dropped["dropped_source"] == 0
    assert dropped["assignment"] == plain["assignment"]


def test_candidates_name_rows_of_the_files(call, tmp_path):
    pairs = [(i, j) for i in range(14) for j in (13 - i, (17 - i) % 14)]
    np.savetxt(tmp_path / "c.txt", pairs, fmt="%d")
    outcome = call("--drop-invalid", "--candidates", tmp_path / "c.txt", "--json", "-")
    assert outcome.exit_code == 0, outcome.output
    assert_pairs_of_files(json.loads(outcome.stdout))
    np.savetxt(tmp_path / "c.txt", [*pairs, (3, 14)], fmt="%d")
    outcome = call("--drop-invalid", "--candidates", tmp_path / "c.txt")
    assert outcome.exit_code == 2
    assert "c.txt: 14 is not a target row; use rows from 0 to 13" in outcome.stderr


def test_matches_name_rows_of_the_files(files, tmp_path):
    np.savetxt(tmp_path / "m.txt", [(i, 13 - i) for i in range(14)], fmt="%d")
    outcome = run(
        "register-matches", *files, tmp_path / "m.txt", "--inlier-distance", "0.1",
        "--drop-invalid", "--json", "-",
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.output
    result = json.loads(outcome.stdout)
    assert_pairs_of_files(result)
    assert result["n_inliers"] == 10


def test_a_sweep_names_rows_of_the_files(files, tmp_path):
    outcome = run(
        "sweep", *files, "--model", "rigid3d", "--n-inliers", "8,9", "--drop-invalid",
        "--out", tmp_path / "o.json",
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.output
    found = json.loads((tmp_path / "o.json").read_text())
    for result in found["results"]:
        assert_pairs_of_files({**found, **result})


def test_a_certificate_is_verified_with_the_option(call, files, tmp_path):
    certificate = tmp_path / "c.npz"
    outcome = call("--drop-invalid", "--mode", "paper", "--certificate", certificate)
    assert outcome.exit_code == 0, outcome.output
    outcome = run("verify", certificate, *files, "--drop-invalid")
    assert outcome.exit_code == 0, outcome.output
    outcome = run("verify", certificate, *files)
    assert outcome.exit_code == 2
    assert "--drop-invalid" in outcome.stderr


def test_a_cloud_without_valid_points_is_refused(files, tmp_path):
    np.savetxt(files[0], np.full((4, 3), np.nan))
    outcome = run("register", *files, "--model", "rigid3d", "--n-inliers", "3", "--drop-invalid")
    assert outcome.exit_code == 2
    assert f"{files[0]}: all 4 points hold NaN or infinity" in outcome.stderr
