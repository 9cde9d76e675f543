"""Files for ``python -m baselines.dcreg_paper``: wrong ones are refused with field, value and remedy."""

from __future__ import annotations

import numpy as np
import pytest

from baselines.dcreg_paper.__main__ import Case, main


def case(**changes):
    """The arrays of a case of six points in 2D, some of them replaced, or left out if None."""
    points = np.random.default_rng(0).random((6, 2))
    arrays = {
        "source": points, "target": points + 3.0, "n_inliers": 6,
        "source_centre": points.mean(axis=0), "target_centre": points.mean(axis=0) + 3.0,
        "unit": 1.0, "lower": np.array([-1.5, -1.5, -1.0, -1.0]),
        "upper": np.array([1.5, 1.5, 1.0, 1.0]), "eps": 0.01,
    }  # fmt: skip
    return {name: value for name, value in (arrays | changes).items() if value is not None}


def run(monkeypatch, capsys, path, *options):
    """Exit code and standard error of the command."""
    monkeypatch.setattr("sys.argv", ["dcreg_paper", str(path), *options])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code, capsys.readouterr().err


def test_a_right_file_is_read_and_solved(tmp_path):
    np.savez(tmp_path / "a.npz", **case(boxes=7))
    read, stated = Case.read(tmp_path / "a.npz")
    assert stated == {"boxes": 7}
    assert read.solve(time_limit=60).upper_bound < 0.01


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"eps": None}, "no array 'eps'; it needs source, target"),
        ({"source": np.ones(6)}, "source: shape (6,); give (n, 2) or (n, 3)"),
        ({"source": np.full((6, 2), np.nan)}, "source: 6 point(s) with NaN"),
        ({"target": np.ones((6, 3))}, "target: shape (6, 3)"),
        ({"source": np.ones((0, 2))}, "source: no points"),
        ({"n_inliers": 7}, "n_inliers: 7 pairs cannot be matched"),
        ({"n_inliers": 0}, "n_inliers: 0 pairs cannot be matched"),
        ({"n_inliers": 2.5}, "n_inliers: 2.5 is not an integer"),
        ({"source_centre": np.array([np.nan, 0.0])}, "source_centre: [nan, 0.0]; give 2 finite"),
        ({"unit": 0.0}, "unit: 0.0 is not a usable value; give a positive number"),
        ({"unit": "m"}, "unit: 'm'; give one finite number"),
        ({"eps": -1.0}, "eps: -1.0 is not a usable value; give 0 or a positive number"),
        ({"eps": [0.1, 0.2]}, "eps: [0.1, 0.2]; give one finite number"),
        ({"lower": np.zeros(3)}, "lower: [0.0, 0.0, 0.0]; give 4 finite numbers"),
        ({"lower": np.full(4, 2.0)}, "lower: [2.0, 2.0, 2.0, 2.0] exceeds upper"),
        ({"boxes": "many"}, "boxes: 'many'; give one finite number"),
    ],
)
def test_a_wrong_array_is_named(changes, words, tmp_path, monkeypatch, capsys):
    path = tmp_path / "a.npz"
    np.savez(path, **case(**changes))
    code, message = run(monkeypatch, capsys, path)
    assert code == 2
    assert f"error: {path}: {words}" in message


def test_other_files_and_limits_are_refused(tmp_path, monkeypatch, capsys):
    path = tmp_path / "a.npz"
    code, message = run(monkeypatch, capsys, path)
    assert (code, "No such file" in message) == (2, True)
    for content in (b"{}", b"PK"):
        path.write_bytes(content)
        code, message = run(monkeypatch, capsys, path)
        assert (code, "not an .npz file of plain arrays" in message) == (2, True)
    np.save(tmp_path / "a.npy", np.ones(3))
    assert run(monkeypatch, capsys, tmp_path / "a.npy")[0] == 2
    np.savez(path, **case())
    code, message = run(monkeypatch, capsys, path, "--time-limit", "-1")
    assert (code, "--time-limit: -1.0 is not a usable value" in message) == (2, True)
