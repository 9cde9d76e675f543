"""``dcreg register-matches`` and the files it reads."""

import json
from functools import partial

import numpy as np
import pytest

import dcreg
from tests import results

run = partial(results.run, "register-matches")


@pytest.fixture
def call(tmp_path):
    """A good call: 20 of 40 matches are right."""
    points = np.random.default_rng(0).random((40, 3))
    np.savetxt(tmp_path / "s.txt", points)
    np.save(tmp_path / "t.npy", np.vstack([points[:20] + 3.0, points[:20]]))
    np.savetxt(tmp_path / "m.txt", [(i, i) for i in range(40)], fmt="%d")
    files = [tmp_path / name for name in ("s.txt", "t.npy", "m.txt")]
    return [*files, "--inlier-distance", "0.02"]


def test_pose_and_files(call, tmp_path):
    outputs = {"--json": "o.json", "--trace": "o.jsonl", "--plot": "o.html"}
    options = [text for option, name in outputs.items() for text in (option, tmp_path / name)]
    outcome = run(*call, *options)
    assert outcome.exit_code == 0, outcome.stderr
    assert "optimal: certified for the rigid pose over the given matches" in (
        " ".join(outcome.stdout.split())
    )
    assert "rotation" in outcome.stderr  # the progress of the search
    written = json.loads((tmp_path / "o.json").read_text())
    np.testing.assert_allclose(np.array(written["T_target_source"])[:3, 3], 3.0, atol=1e-6)
    assert written["n_inliers"] == 20
    assert written["matches"] == str(call[2])
    assert all((tmp_path / name).stat().st_size for name in outputs.values())


def test_options_reach_the_library(call, monkeypatch):
    given = {}

    def record(*clouds_and_matches, **options):
        given.update(options, matches=clouds_and_matches[2])
        raise dcreg.InputError("inlier_distance: 7.0")

    monkeypatch.setattr(dcreg, "register_matches", record)
    options = {
        "--rel-gap": 0.1,
        "--abs-gap": 0.5,
        "--time-limit": 3,
        "--node-limit": 9,
        "--inlier-distance": 7,
    }
    chosen = [text for pair in options.items() for text in pair]
    outcome = run(*call, "--no-certify", *chosen)
    assert outcome.exit_code == 2
    assert "error: --inlier-distance: 7.0" in outcome.stderr
    np.testing.assert_array_equal(given["matches"], [(i, i) for i in range(40)])
    assert given["certify"] is False
    names = ("inlier_distance", "rel_gap", "abs_gap", "time_limit", "node_limit")
    assert [given[name] for name in names] == [7.0, 0.1, 0.5, 3.0, 9]


def test_a_limit_has_its_exit_code(call):
    np.savetxt(call[0], np.random.default_rng(1).random((40, 3)))  # no match is right
    outcome = run(*call, "--inlier-distance", "0.2", "--node-limit", "8", "--quiet")
    assert outcome.exit_code == 3
    assert outcome.stdout.split()[1] == "node_limit:"
    assert "a pose with a score of up to 20 is not ruled out" in " ".join(outcome.stdout.split())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("0 0 0\n1 1 1\n", "m.txt: not a table of pairs; give two columns"),
        ("0 0.5\n1 1\n2 2\n", "m.txt: not a table of pairs; give two columns"),
        ("0 0\n1 1\n40 2\n", "m.txt: 40 is not a source row; use rows from 0 to 39"),
        ("0 0\n1 1\n2 -1\n", "m.txt: -1 is not a target row; use rows from 0 to 39"),
        ("0 0\n1 1\n1 1\n", "matches: 2 different ones; a rigid pose needs 3"),
        ("", "m.txt: "),
        (None, "m.txt: no such file; check the path"),
    ],
)
def test_bad_matches_exit_2_and_name_the_file(call, content, words):
    call[2].unlink()
    if content is not None:
        call[2].write_text(content)
    outcome = run(*call)
    assert outcome.exit_code == 2
    assert words in " ".join(outcome.stderr.split()).replace("\n", "")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--inlier-distance", "-1"], "--inlier-distance: -1.0 is not a positive number"),
        (["--inlier-distance", "wide"], "'wide' is not a number"),
        (["--time-limit", "0"], "--time-limit: 0.0"),
        (["--json", "absent/o.json"], "no folder 'absent'; create it first"),
        (["--plot", "o.png"], "the name must end in .html"),
    ],
)
def test_bad_options_exit_2(call, options, words):
    outcome = run(*call, *options)
    assert outcome.exit_code == 2
    assert words in " ".join(outcome.stderr.replace("│", " ").split())


def test_2d_clouds_are_refused(call, tmp_path):
    np.savetxt(tmp_path / "s.txt", np.random.default_rng(0).random((40, 2)))
    outcome = run(*call)
    assert outcome.exit_code == 2
    assert "s.txt: points have 2 coordinates" in outcome.stderr


def test_inputs_are_not_overwritten(call):
    outcome = run(*call, "--json", call[2])
    assert outcome.exit_code == 2
    assert "is also an input" in outcome.stderr
