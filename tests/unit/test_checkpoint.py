"""Checkpoints: a search that was stopped or killed continues as if it had not been interrupted."""

import logging
import os
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import dcreg
from dcreg.driver import checkpoint
from dcreg.families.rigid3d.cover import CongruentCover
from dcreg.search import space_search
from dcreg.status import Status
from tests.problems import register
from tests.results import run

# By model: pairs that match and those that are searched, of 34 points each; noise; and numbers of boxes
# at which the search is stopped: before the cover, in the part that proves a share (3D), after the cover.
SEARCHES = {
    "similarity2d": (24, 22, 0.1, (40, 500)),
    "rigid3d": (30, 30, 0.05, (40, 800, 3000)),
}


def clouds_of(model):
    n_common, k, noise, _ = SEARCHES[model]
    rng, dim = np.random.default_rng(3), 2 if model == "similarity2d" else 3
    source, target = rng.standard_normal((34, dim)), rng.standard_normal((34, dim))
    target[:n_common] = source[:n_common] + noise * rng.standard_normal((n_common, dim))
    return (source, target), {
        "model": model,
        "n_inliers": k,
        "time_limit": None,
        "node_limit": 9000,
    }


def cover_early(set_value=setattr):
    """Let covers confine the search early."""
    set_value(space_search, "SHORT", 128)
    set_value(CongruentCover, "shares", (0.5, 1.0))


@pytest.fixture(autouse=True)
def early(monkeypatch):
    cover_early(monkeypatch.setattr)


@pytest.fixture(params=SEARCHES)
def search(request):
    clouds, settings = clouds_of(request.param)
    return partial(register, *clouds, **settings), SEARCHES[request.param][-1]


def planar(**settings):
    """Search a small problem."""
    (source, target), given = clouds_of("similarity2d")
    return register(source[:9], target[:9], **{**given, "n_inliers": 8, **settings})


@pytest.fixture
def stopped(tmp_path):
    """The file of a search that was stopped."""
    planar(node_limit=40, checkpoint=tmp_path / "state.npz")
    return tmp_path / "state.npz"


def assert_same(found, expected):
    """Compare all that does not depend on the clock."""
    for name in ("status", "lower_bound", "upper_bound", "n_nodes", "n_assignments", "objective"):
        assert getattr(found, name) == getattr(expected, name), name
    np.testing.assert_array_equal(found.T_target_source, expected.T_target_source)
    np.testing.assert_array_equal(found.assignment, expected.assignment)
    plain = partial(replace, time_s=0.0)
    assert [*map(plain, found.stages)] == [*map(plain, expected.stages)]
    np.testing.assert_array_equal(
        found.runner_up.T_target_source, expected.runner_up.T_target_source
    )


def test_a_search_stopped_by_boxes_continues_to_the_same_result(search, tmp_path):
    solve, stops = search
    expected, path = solve(), tmp_path / "state.npz"
    assert expected.status is Status.OPTIMAL
    for at, stop in enumerate(stops):
        found = solve(node_limit=stop, checkpoint=path, threads=1 + at % 2)
        assert found.status is Status.NODE_LIMIT
        assert stop <= found.n_nodes < expected.n_nodes
    earlier_s = found.time_solve_s
    assert found.time_earlier_s > 0.0
    found = solve(checkpoint=path)
    assert_same(found, expected)
    assert expected.time_earlier_s == 0.0 < found.time_earlier_s < found.time_solve_s
    assert found.time_earlier_s == pytest.approx(earlier_s, rel=0.5)
    assert "s for the solve in all calls (" in str(found)
    assert "in all calls" not in str(expected)
    changes = [
        [(each.n_nodes, each.lower_bound, each.upper_bound) for each in result.trace]
        for result in (found, expected)
    ]
    assert set(changes[1]) <= set(changes[0])
    # the file of a finished search gives its result again
    assert_same(solve(checkpoint=path), expected)
    assert [each.name for each in tmp_path.iterdir()] == ["state.npz"]


def die_while_writing(path, count):
    """Write a checkpoint after every round, and kill the process in the middle of number `count`."""
    cover_early()
    checkpoint.INTERVAL_S, checkpoint.WRITING_SHARE = 0.0, np.inf
    save, left = np.savez, iter(range(count, 0, -1))

    def savez(stream, **arrays):
        if next(left) == 1:
            stream.write(b"PK")
            stream.flush()
            os.kill(os.getpid(), signal.SIGKILL)
        save(stream, **arrays)

    np.savez = savez
    planar(checkpoint=path)


def test_a_killed_search_continues_to_the_same_result(tmp_path):
    path = tmp_path / "state.npz"
    code = f"from tests.unit.test_checkpoint import *; die_while_writing({str(path)!r}, 20)"
    folder = Path(__file__).parents[2]
    killed = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert planar(node_limit=1, checkpoint=path).n_nodes > 100
    assert_same(planar(checkpoint=path), planar())


def test_the_certificate_of_a_continued_search_is_proven(tmp_path):
    solve = partial(planar, checkpoint=tmp_path / "c", certificate=True)
    solve(node_limit=100)
    found = solve()
    assert found.status is Status.OPTIMAL
    source, target = (points[:9] for points in clouds_of("similarity2d")[0])
    assert dcreg.verify(found.certificate, source, target).accepted


def test_a_search_stopped_within_a_round_continues_with_valid_bounds(tmp_path, monkeypatch):
    def interrupted(self, boxes, cutoff):
        if self.n_assignments > 100 and not self.space.stop_flag[0]:
            self.space.stop_flag[0] = 1
            stopping.append(True)
        return evaluate(self, boxes, cutoff)

    from dcreg.families.protocol import SpaceBound

    evaluate, stopping = SpaceBound.evaluate, []
    with monkeypatch.context() as patch:
        patch.setattr(SpaceBound, "evaluate", interrupted)
        found = planar(checkpoint=tmp_path / "c")
    assert stopping
    assert found.status is Status.TIME_LIMIT
    expected, found = planar(), planar(checkpoint=tmp_path / "c")
    assert found.status is Status.OPTIMAL
    assert found.upper_bound == pytest.approx(expected.upper_bound, rel=1e-9)
    assert expected.upper_bound * 0.99 <= found.lower_bound <= found.upper_bound


# --- refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, 100, -50])
def test_a_truncated_file_is_refused(stopped, size):
    stopped.write_bytes(stopped.read_bytes()[:size])
    with pytest.raises(
        dcreg.InputError, match=r"is not a checkpoint, or is damaged .*; name another file"
    ):
        planar(checkpoint=stopped)


def test_another_file_is_refused_and_kept(tmp_path):
    (tmp_path / "points.txt").write_text("1 2\n3 4\n")
    with pytest.raises(dcreg.InputError, match="is not a checkpoint"):
        planar(checkpoint=tmp_path / "points.txt")
    assert (tmp_path / "points.txt").read_text() == "1 2\n3 4\n"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rel_gap": 0.1}, r"a search with rel_gap 0\.01, not 0\.1; give the same options"),
        ({"n_inliers": 7}, "a search with n_inliers 8, not 7"),
        ({"bound": "shared"}, "a search with bound default, not shared"),
        ({"scale_range": (1.0, 1.0)}, r"with scale_range \[0\.5, 1\.5\], not \[1\.0, 1\.0\]"),
        ({"init": np.eye(3)}, "a search from another pose; give"),
    ],
)
def test_other_options_are_refused(stopped, change, message):
    with pytest.raises(dcreg.InputError, match=message):
        planar(checkpoint=stopped, **change)


def test_another_problem_is_refused(stopped):
    (source, target), settings = clouds_of("similarity2d")
    target[3, 1] += 1e-12
    with pytest.raises(dcreg.InputError, match=r"another problem \(target differs\)"):
        register(source[:9], target[:9], **settings | {"n_inliers": 8}, checkpoint=stopped)


def test_a_run_that_ends_within_the_initial_poses_writes_no_file(tmp_path):
    planar(time_limit=1e-9, checkpoint=tmp_path / "state.npz")
    assert not (tmp_path / "state.npz").exists()


def test_other_attributes_are_refused(stopped):
    attributes = dcreg.Attributes(np.arange(9.0), np.arange(9.0), scale=0.1)
    with pytest.raises(dcreg.InputError, match=r"another problem \(attributes differs\)"):
        planar(checkpoint=stopped, attributes=attributes)


def test_other_weights_are_refused(stopped):
    weights = dcreg.PointWeights(source=[0.5, *[1.0] * 8], distance=1.0)
    with pytest.raises(dcreg.InputError, match=r"another problem \(weights differs\)"):
        planar(checkpoint=stopped, weights=weights)


def test_another_version_is_refused(stopped, monkeypatch):
    monkeypatch.setattr(checkpoint, "__version__", "0.0")
    with pytest.raises(dcreg.InputError, match=r"written by dcreg .*, but this is dcreg 0\.0"):
        planar(checkpoint=stopped)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mode": "paper"}, "mode 'paper' searches norms, .*; use mode 'full'"),
        ({"pose_range": dcreg.PoseRange(max_angle=20.0)}, "limits of angle or translation"),
        ({"checkpoint": "nowhere/a.npz"}, "no folder 'nowhere'; create it first"),
        ({"checkpoint": 3}, "3 is not a path"),
    ],
)
def test_what_cannot_be_continued_is_refused_before_the_search(settings, message, tmp_path):
    clouds, given = clouds_of("rigid3d")
    with pytest.raises(dcreg.InputError, match=f"checkpoint: .*{message}"):
        register(*clouds, **{**given, "checkpoint": tmp_path / "c", **settings})
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("ask", ["sweep", "alternatives", "max_inliers"])
def test_other_questions_refuse_a_checkpoint(ask, tmp_path):
    clouds, _ = clouds_of("similarity2d")
    given = {
        "sweep": {"n_inliers": [3]},
        "alternatives": {"n_inliers": 3},
        "max_inliers": {"distance": 1.0},
    }
    options = dcreg.SolveOptions(checkpoint=tmp_path / "c")
    with pytest.raises(dcreg.InputError, match="checkpoint: only register and certify"):
        getattr(dcreg, ask)(*clouds, **given[ask], model="similarity2d", options=options)


def test_a_checkpoint_that_cannot_be_written_does_not_end_the_search(tmp_path, monkeypatch, caplog):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "_write", full)
    with caplog.at_level(logging.WARNING, "dcreg"):
        found = planar(checkpoint=tmp_path / "c", node_limit=40)
    assert found.status is Status.NODE_LIMIT
    assert "cannot be written (No space left on device); the search continues" in caplog.text


def test_the_command_continues_and_says_so(tmp_path):
    clouds, _ = clouds_of("similarity2d")
    files = [tmp_path / "a.npy", tmp_path / "b.npy"]
    for file, points in zip(files, clouds, strict=True):
        np.save(file, points[:9])
    call = (
        "register",
        *files,
        *("--model", "similarity2d", "--n-inliers", "8", "--checkpoint", tmp_path / "c"),
    )
    assert run(*call, "--node-limit", "40").exit_code == 3
    continued = run(*call)
    assert continued.exit_code == 0
    assert f"continuing the search of {tmp_path / 'c'}: 63 boxes" in continued.output.replace(
        "\n", ""
    )
    assert "optimal" in continued.output
