"""``dcreg batch``: a table of pairs, its results, and what is kept when the command runs again."""

import csv
import logging
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

import dcreg
from dcreg.cli import batch
from dcreg.cli.folder import in_order
from dcreg.cli.options import Poses, Search
from dcreg.cli.pair import Task, failed
from dcreg.cli.workers import print_when_compiling, solve_all
from dcreg.names import COMPILING
from tests.results import run


@pytest.fixture
def table(tmp_path):
    """Three scans in a folder, and a table of two pairs; scan i is scan 0 turned by i quarters."""
    points = np.random.default_rng(2).random((10, 3))
    folder = tmp_path / "scans"
    folder.mkdir()
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rng = np.random.default_rng(3)
    for i in range(3):
        scan = points @ np.linalg.matrix_power(turn, i).T + [i, 0, 0]
        np.savetxt(folder / f"{i}.txt", scan + 1e-4 * rng.standard_normal(scan.shape))
    return write(tmp_path, "source,target,n_inliers\n0.txt,1.txt,\n1.txt,2.txt,8\n")


def write(folder, text):
    path = folder / "scans" / "pairs.csv"
    path.write_text(text)
    return path


def call(table, *options, model="rigid3d"):
    out = table.parents[1] / "out.csv"
    return run("batch", table, "--out", out, "--model", model, "--n-inliers", "0.9", *options)


def rows(table):
    with (table.parents[1] / "out.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def pose(row, size=4):
    return np.array([[float(row[f"T{i}{j}"]) for j in range(size)] for i in range(size)])


@pytest.fixture
def solved(monkeypatch):
    """The pairs that are solved, in this process; results are at once there."""
    found = []

    def solve_at_once(tasks, jobs, is_stopped, quiet):
        for task in tasks:
            found.append(task)
            yield task, batch_row(task)

    monkeypatch.setattr(batch, "solve_all", solve_at_once)
    return found


def batch_row(task):
    if "bad" in task.source:
        return failed("bad.txt: no such file")
    T = {f"T{i}{j}": str(float(i == j)) for i in range(4) for j in range(4)}
    status = "time_limit" if task.n_inliers == "3" else "converged"
    return {"status": status, "rmse_matched": "0.5", "time_s": "1.0", **T}


# --- results ----------------------------------------------------------------------------------------


def test_each_pair_has_the_result_of_register(table, tmp_path):
    outcome = call(table, "--graph", tmp_path / "o.g2o", "--jobs", "2")
    assert outcome.exit_code == 0, outcome.output
    assert outcome.stdout == "2 pairs: 2 optimal\n"
    assert "[2/2] " in outcome.stderr
    first, second = rows(table)
    assert [first[name] for name in ("source", "target", "n_inliers")] == ["0.txt", "1.txt", "9"]
    assert second["n_inliers"] == "8"
    assert first["certificate_scope"] == "rigid pose"
    clouds = [dcreg.read_points(table.parent / f"{i}.txt") for i in range(2)]
    result = dcreg.register(*clouds, n_inliers=0.9, model="rigid3d")
    np.testing.assert_array_equal(pose(first), result.T_target_source)
    for name in ("objective", "lower_bound", "upper_bound", "rmse_matched"):
        assert float(first[name]) == getattr(result, name)
    upper = result.covariance[np.triu_indices(6)]
    np.testing.assert_array_equal(np.array(first["covariance"].split(), dtype=float), upper)
    lines = (tmp_path / "o.g2o").read_text().splitlines()
    assert [line.split()[:2] for line in lines[:3]] == [
        ["VERTEX_SE3:QUAT", f"{i}"] for i in range(3)
    ]
    assert [line.split()[:3] for line in lines[3:]] == [
        ["EDGE_SE3:QUAT", "1", "0"],
        ["EDGE_SE3:QUAT", "2", "1"],
    ]
    assert "identity" not in outcome.stderr


def test_2d_with_a_fixed_scale(table, tmp_path):
    for i in range(3):
        scan = np.loadtxt(table.parent / f"{i}.txt")[:, :2]
        np.savetxt(table.parent / f"{i}.txt", scan)
    graph = ("--graph", tmp_path / "o.g2o")
    outcome = call(table, *graph, model="similarity2d")
    assert outcome.exit_code == 2
    assert "fix the scale with --scale-range 1 1" in outcome.stderr
    outcome = call(table, *graph, "--scale-range", "1", "1", model="similarity2d")
    assert outcome.exit_code == 0, outcome.output
    assert pose(rows(table)[0], 3) == pytest.approx(
        np.array([[0, -1, 1], [1, 0, 0], [0, 0, 1]]), abs=0.01
    )
    edge = (tmp_path / "o.g2o").read_text().splitlines()[-1].split()
    assert edge[:3] == ["EDGE_SE2", "2", "1"]
    assert len(edge) == 3 + 3 + 6


def test_every_pair_has_the_range_of_poses(table):
    outcome = call(table, "--no-rotation")
    assert outcome.exit_code in (0, 3), outcome.output
    for row in rows(table):
        np.testing.assert_allclose(pose(row)[:3, :3], np.eye(3), atol=1e-9)
    outcome = call(table, "--axis", "up")
    assert (outcome.exit_code, outcome.stdout) == (2, "")
    assert "--axis: 'up' is not a direction" in outcome.stderr


def test_a_failed_pair_does_not_stop_the_others(table, tmp_path):
    np.savetxt(table.parent / "nan.txt", np.full((5, 3), np.nan))
    scan = np.loadtxt(table.parent / "0.txt")
    scan[2] = np.nan
    np.savetxt(table.parent / "gap.txt", scan)
    write(
        tmp_path,
        "source,target,n_inliers\nabsent.txt,1.txt,\n0.txt,1.txt,99\nnan.txt,1.txt,\ngap.txt,1.txt,7\n",
    )
    outcome = call(table, "--drop-invalid", "--quiet", "--graph", tmp_path / "o.g2o")
    assert outcome.exit_code == 2
    assert outcome.stdout == "4 pairs: 3 failed, 1 optimal\n"
    assert len(outcome.stderr.splitlines()) == 3
    absent, many, invalid, good = rows(table)
    assert "absent.txt: no such file" in absent["error"]
    assert many["error"].startswith("--n-inliers: 99 pairs")
    assert "all 5 points hold NaN" in invalid["error"]
    assert {row["status"] for row in (absent, many, invalid)} == {"failed"}
    assert (good["status"], good["dropped_source"], good["dropped_target"]) == ("optimal", "1", "0")
    assert (tmp_path / "o.g2o").read_text().count("EDGE") == 1


class Ends:
    """A task that ends the process which receives it."""

    def __init__(self, *ending):
        self.ending = ending

    def __reduce__(self):
        return self.ending


def test_a_crash_costs_only_its_pair(table):
    search = Search(model="rigid3d")
    files = [str(table.parent / f"{i}.txt") for i in range(2)]
    good = Task(2, *files, "5", None, search, Poses(), drop_invalid=False)
    tasks = [Ends(os._exit, (7,)), Ends(signal.raise_signal, (signal.SIGKILL,)), good]
    found = [row for _, row in solve_all(tasks, 1, lambda: False)]
    assert found[0]["error"] == "the process ended with code 7"
    assert found[1]["error"] == "the process ended with signal 9"
    assert found[2]["status"] == "optimal"


@pytest.mark.parametrize(
    ("lines", "code", "shares"),
    [
        ("0.txt,1.txt,4\n", 0, "1 pairs: 1 converged"),
        ("0.txt,1.txt,3\n1.txt,2.txt,4\n", 3, "2 pairs: 1 time_limit, 1 converged"),
        ("0.txt,1.txt,3\nbad.txt,2.txt,4\n", 2, "2 pairs: 1 time_limit, 1 failed"),
    ],
)
def test_exit_codes(table, tmp_path, solved, lines, code, shares):
    write(tmp_path, f"source,target,n_inliers\n{lines}")
    outcome = call(table)
    assert outcome.exit_code == code
    assert outcome.stdout == f"{shares}\n"


def test_poses_without_a_covariance_are_named(table, tmp_path, solved):
    outcome = call(table, "--graph", tmp_path / "o.g2o")
    assert outcome.exit_code == 0
    assert outcome.stderr.count("the information matrix of its edge is the identity") == 2
    assert "warning: 0.txt 1.txt: the covariance is missing" in outcome.stderr


# --- residuals and folders --------------------------------------------------------------------------


def test_pairs_above_a_residual_are_refuted_and_have_no_edge(table, tmp_path):
    noise = np.random.default_rng(5).random((10, 3))
    np.savetxt(table.parent / "other.txt", noise)
    write(tmp_path, "source,target\n0.txt,1.txt\n0.txt,other.txt\n")
    outcome = call(table, "--max-rms", "0.01", "--graph", tmp_path / "o.g2o", "--quiet")
    assert outcome.exit_code == 0, outcome.output
    assert [row["status"] for row in rows(table)] == ["converged", "refuted"]
    assert (tmp_path / "o.g2o").read_text().count("EDGE") == 1


def test_a_pair_without_an_answer_about_a_residual_is_open(table, tmp_path, solved):
    outcome = call(table, "--max-rms", "0.1", "--graph", tmp_path / "o.g2o")
    assert (outcome.exit_code, outcome.stdout) == (3, "2 pairs: 2 open\n")
    assert "EDGE" not in (tmp_path / "o.g2o").read_text()
    assert call(table, "--max-rms", "0.6").exit_code == 0
    assert len(solved) == 4


def test_a_residual_is_met_up_to_rounding_as_in_register(table, tmp_path, solved):
    """The RMS residual of the rows is 0.5."""
    graph = tmp_path / "o.g2o"
    assert call(table, "--max-rms", "0.49999999999", "--graph", graph).exit_code == 0
    assert graph.read_text().count("EDGE") == 2


def test_messages_about_a_pair_name_the_options_given(table):
    write(table.parents[1], "source,target\n0.txt,1.txt\n")
    outcome = call(table, "--axis", "0,0,1", "--scale-range", "1", "2", model="similarity3d")
    assert "0.txt 1.txt: --axis: not supported by similarity3d; omit --axis" in outcome.stderr
    (table.parent / "candidates.txt").write_text("0 0\n0 99\n")
    outcome = call(table, "--candidates", table.parent / "candidates.txt")
    assert "0.txt 1.txt: --candidates" in outcome.stderr


def folder_call(folder, *options):
    named = "--out", folder / "out.csv", "--model", "rigid3d", "--n-inliers", "0.9"
    return run("batch", folder, *named, *options)


def test_a_folder_without_a_table_holds_consecutive_scans(table, solved):
    folder = table.parent
    table.unlink()
    (folder / "0.txt").rename(folder / "10.txt")
    (folder / "notes.md").write_text("no points")
    for _ in range(2):  # the second call continues: the table of results is no cloud
        outcome = folder_call(folder, "--graph", folder / "out.g2o")
        assert outcome.exit_code == 0, outcome.output
    assert [(task.source, task.target) for task in solved] == [
        (str(folder / "2.txt"), str(folder / "1.txt")),
        (str(folder / "10.txt"), str(folder / "2.txt")),
    ]
    with (folder / "out.csv").open(newline="") as stream:
        found = [(row["source_id"], row["target_id"]) for row in csv.DictReader(stream)]
    assert found == [("1", "0"), ("2", "1")]


def test_the_files_of_options_are_no_clouds(table, solved):
    """They may lie in the folder; a superscript is no number in a name."""
    folder = table.parent
    table.unlink()
    (folder / "0.txt").rename(folder / "\N{SUPERSCRIPT TWO}0.txt")
    np.savetxt(folder / "pose.txt", np.eye(4))
    np.savetxt(folder / "candidates.txt", np.tile(np.arange(10), (2, 1)).T, "%d")
    options = "--init", folder / "pose.txt", "--candidates", folder / "candidates.txt"
    assert folder_call(folder, *options).exit_code == 0
    assert len(solved) == 2


def test_tables_of_results_and_folders_are_no_clouds(table, solved):
    folder = table.parent
    table.unlink()
    assert folder_call(folder).exit_code == 0
    (folder / "more.txt").mkdir()
    (folder / "out.csv").rename(folder / "first.csv")
    assert folder_call(folder).exit_code == 0
    assert len((folder / "out.csv").read_text().splitlines()) == 3


def test_names_with_superscripts_and_equal_numbers_have_an_order():
    assert sorted(["a3\u00b21.txt", "a3.txt", "a2.txt"], key=in_order)[0] == "a2.txt"


def test_the_table_of_a_folder_names_its_pairs(table, solved):
    assert folder_call(table.parent).exit_code == 0
    assert [task.n_inliers for task in solved] == ["0.9", "8"]


def test_a_folder_can_hold_named_pairs(tmp_path, solved):
    for name in ("b_source.ply", "b_target.txt", "a2_source.npy", "a2_target.npy", "b_pose.txt"):
        (tmp_path / name).write_text("")
    assert folder_call(tmp_path).exit_code == 0
    assert [tuple(task.source.rpartition("/")[::2]) for task in solved] == [
        (str(tmp_path), "a2_source.npy"),
        (str(tmp_path), "b_source.ply"),
    ]
    assert [task.target.rpartition("/")[2] for task in solved] == ["a2_target.npy", "b_target.txt"]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (
            [],
            "contains 0 point files, but a pair needs two; give another folder or a table of pairs",
        ),
        (["a.txt", "a.png", ".b.txt"], "contains 1 point files"),
        (["a_source.txt", "b.txt"], "a_source.txt has no counterpart a_target; add it, or list"),
        (["a_target.txt", "b.txt"], "a_target.txt has no counterpart a_source; add it, or list"),
        (
            ["a_source.txt", "a_source.ply", "a_target.ply"],
            "are both a_source; keep one, or list the pairs in",
        ),
    ],
)
def test_a_folder_without_pairs_is_refused(tmp_path, solved, names, words):
    for name in names:
        (tmp_path / name).write_text("")
    outcome = folder_call(tmp_path)
    assert outcome.exit_code == 2
    assert words in outcome.stderr
    assert not solved


# --- resuming ---------------------------------------------------------------------------------------


def test_finished_pairs_are_kept(table, tmp_path, solved):
    call(table)
    before = rows(table)
    outcome = call(table)
    assert len(solved) == 2
    assert "2 of 2 pairs are in" in outcome.stderr
    assert rows(table) == before
    # a row of its own for each pair, in the order of the table
    write(tmp_path, "source,target,n_inliers\n1.txt,0.txt,5\n1.txt,2.txt,8\n0.txt,1.txt,\n")
    call(table)
    assert len(solved) == 3
    names = [(row["source"], row["target"], row["source_id"]) for row in rows(table)]
    assert names == [("1.txt", "0.txt", "0"), ("1.txt", "2.txt", "0"), ("0.txt", "1.txt", "1")]


def test_other_files_and_options_are_solved_again(table, solved):
    call(table)
    np.savetxt(table.parent / "0.txt", np.eye(3))
    call(table)
    assert [task.place for task in solved] == [0, 1, 0]
    call(table, "--time-limit", "7")
    call(table, "--drop-invalid")
    call(table, "--max-angle", "100")
    assert len(solved) == 9
    assert len(rows(table)) == 2


def test_failed_pairs_are_tried_again_and_limits_are_not(table, tmp_path, solved):
    write(tmp_path, "source,target,n_inliers\nbad.txt,1.txt,4\n0.txt,1.txt,3\n")
    assert call(table).exit_code == 2
    assert call(table).exit_code == 2
    assert [task.place for task in solved] == [0, 1, 0]
    assert [row["status"] for row in rows(table)] == ["failed", "time_limit"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_an_interrupted_batch_continues(table, tmp_path, number):
    """The second pair is unrelated noise: its search takes its whole time limit."""
    for name in "ab":
        points = np.random.default_rng(ord(name)).random((60, 3))
        np.savetxt(table.parent / f"{name}.txt", points)
    write(tmp_path, "source,target,n_inliers\n0.txt,1.txt,9\na.txt,b.txt,0.5\n")
    command = [sys.executable, "-m", "dcreg", "batch", table, "--out", tmp_path / "out.csv"]
    command += ["--model", "rigid3d", "--prove", "--time-limit", "5", "--rel-gap", "0"]
    process = subprocess.Popen(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr.readline().startswith("[1/2] 0.txt 1.txt: optimal")
        time.sleep(0.5)
        process.send_signal(number)
        # the processes of the pairs hold standard error open: they have ended, too
        stdout, stderr = process.communicate(timeout=60)
    finally:
        process.kill()
    before = rows(table)
    assert [row["status"] for row in before] == ["optimal"]
    if number == signal.SIGINT:
        assert process.returncode == 3, stderr
        assert stdout == "2 pairs: 1 optimal, 1 not solved\n"
        assert "run the same command again" in stderr
    outcome = run(*command[3:])
    assert outcome.exit_code == 3, outcome.output
    after = rows(table)
    assert after[0] == before[0]
    assert after[1]["status"] == "time_limit"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.csv", "scans"]


def test_a_full_disk_ends_the_batch(table, solved, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(batch, "write_text", fail)
    outcome = call(table)
    assert outcome.exit_code == 4
    assert "No space left on device; free some space, then run the command again" in outcome.stderr
    assert solved == []


def test_an_unwritable_graph(table, tmp_path, solved, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(dcreg, "write_pose_graph", fail)
    outcome = call(table, "--graph", tmp_path / "o.g2o")
    assert outcome.exit_code == 4
    assert "cannot write" in outcome.stderr
    assert len(rows(table)) == 2


# --- bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("source,n_inliers\n0.txt,3\n", "no column 'target'; let the first line name the columns"),
        ("source,target\n", "contains no pairs; give one per line"),
        ("", "'source', 'target' and, if wanted, 'n_inliers'"),
        ("source,target\n0.txt\n", "line 2 has no target; add it"),
        (
            "source,target,n_inliers\n0.txt,1.txt,many\n",
            "line 2: --n-inliers: 'many' is not a number",
        ),
        ("source,target\n\xff,1.txt\n", "give a table of pairs in UTF-8"),
        (None, "cannot be read (No such file or directory)"),
    ],
)
def test_a_bad_table_is_refused(table, solved, text, words):
    table.unlink()
    if text is not None:
        table.write_bytes(text.encode("latin-1"))
    outcome = call(table)
    assert outcome.exit_code == 2
    assert f"error: {table}: " in outcome.stderr
    assert words in outcome.stderr
    assert not solved


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--jobs", "0"], "--jobs: 0 processes; give a positive number"),
        (
            ["--model", "rigid2d"],
            "--model: 'rigid2d' is unknown; known: similarity2d, rigid3d, similarity3d",
        ),
        (["--out", "o.txt"], "--out o.txt: the name must end in .csv"),
        (["--max-rms", "0"], "--max-rms: 0.0 is no positive finite number"),
        (["--max-rms", "0.1", "--n-inliers", "auto"], "--n-inliers: missing for 0.txt 1.txt, but"),
        (["--graph", "o.txt"], "--graph o.txt: the name must end in .g2o"),
        (["--graph", "absent/o.g2o"], "no folder 'absent'; create it first"),
    ],
)
def test_bad_options_are_refused(table, solved, options, words):
    outcome = call(table, *options)
    assert outcome.exit_code == 2
    assert words in outcome.stderr
    assert not solved


def test_a_file_of_something_else_is_not_overwritten(table, solved):
    out = table.parents[1] / "out.csv"
    out.write_text("my,notes\n")
    outcome = call(table)
    assert outcome.exit_code == 2
    assert "is not a table of `dcreg batch` for this model; name another file" in outcome.stderr
    assert out.read_text() == "my,notes\n"
    outcome = run("batch", table, "--out", table, "--model", "rigid3d", "--n-inliers", "3")
    assert "is also an input" in outcome.stderr


def test_a_worker_says_that_it_compiles_and_nothing_else(capfd):
    with isolated_logger():
        print_when_compiling()
        logging.getLogger("dcreg").info(COMPILING)
        logging.getLogger("dcreg").info("anything else")
    assert capfd.readouterr().err == COMPILING + "\n"


@contextmanager
def isolated_logger():
    """The library's logger as it was, afterwards."""
    library = logging.getLogger("dcreg")
    level, handlers = library.level, list(library.handlers)
    try:
        yield
    finally:
        library.setLevel(level)
        library.handlers[:] = handlers
