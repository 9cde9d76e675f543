"""The command line: options, exit codes, outputs, messages; with a made-up and the real search."""

import io
import json
import logging
import math
import os
import resource
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import psutil
import pytest
from rich.console import Console
from typer.testing import CliRunner

import dcreg
from dcreg import Event, Result, Stage, Status, SweepResult, Trace
from dcreg.cli import output
from dcreg.cli.app import app
from dcreg.cli.interrupts import Interrupt, leave, raise_again
from dcreg.cli.options import ModelChoice
from dcreg.cli.progress import Progress, ProofProgress
from dcreg.files import whole_file
from dcreg.io import READERS
from dcreg.names import DEFAULT_TIME_LIMIT_S, MODEL_DIM

ISSUE_KEYS = {
    *("status", "T_target_source", "scale", "n_inliers", "bound", "mode", "lower_bound"),
    *("upper_bound", "gap", "gap_tol", "n_nodes", "n_assignments", "time_solve_s"),
    *("certificate_scope", "rmse_matched", "assignment"),
}


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def event(kind="bound", stage="search", time_s=0.0, n_nodes=1, lower=0.0, upper=1.0, status=""):
    return Event(kind, stage, time_s, n_nodes, 16 * n_nodes, 3, lower, upper, status)


@pytest.fixture
def clouds(tmp_path):
    """A small 2D pair with a known pose: 12 points, turned by 0.4, scaled by 1.2, moved."""
    source = np.random.default_rng(3).random((12, 2))
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    target = 1.2 * source @ turn.T + [5.0, -2.0]
    np.savetxt(tmp_path / "source.txt", source)
    np.savez(tmp_path / "target.npz", a=target, b=target[:6])
    return tmp_path / "source.txt", f"{tmp_path / 'target.npz'}:a"


@pytest.fixture
def call(clouds):
    """The arguments of a good call; others are appended."""
    return ["register", *clouds, "--model", "similarity2d", "--n-inliers", "0.8"]


@pytest.fixture
def fake(monkeypatch):
    """`dcreg.register` replaced by one that records its arguments and returns at once."""

    class Fake:
        status = Status.OPTIMAL
        lower_bound = 0.5
        stages = ()
        error: Exception | None = None
        called = None

        def __call__(self, source, target, **options):
            self.called = {"source": source, "target": target, **options}
            if self.error is not None:
                raise self.error
            options["listener"](event("end", upper=1.0, status=self.status.value))
            d = source.shape[1]
            return Result(
                status=self.status,
                model=options["model"],
                mode="paper",
                bound="tight",
                T_target_source=np.eye(d + 1),
                T_certified=np.eye(d + 1),
                assignment=np.array([[0, 0]]),
                n_inliers=options["n_inliers"],
                lower_bound=self.lower_bound,
                upper_bound=1.0,
                gap_tol=options["gap_tol"] or 0.1,
                certificate_scope="similarity pose",
                objective=1.0,
                objective_certified=1.0,
                n_nodes=np.int64(7),
                n_assignments=112,
                time_setup_s=0.1,
                time_solve_s=0.2,
                stages=list(self.stages),
                trace=Trace([event(), event("end", status=self.status.value)]),
            )

    made = Fake()
    monkeypatch.setattr(dcreg, "register", made)
    return made


# --- options --------------------------------------------------------------------------------------


def test_options_reach_the_library(call, fake):
    outcome = run(
        *(*call, "--scale-range", 0.9, 1.1, "--mode", "paper", "--bound", "interval"),
        *("--gap-tol", 0.25, "--time-limit", 9, "--node-limit", 77, "--threads", 2, "--no-polish"),
    )
    assert outcome.exit_code == 0
    expected = {
        **{"model": "similarity2d", "n_inliers": 9, "scale_range": (0.9, 1.1), "mode": "paper"},
        **{"bound": "interval", "gap_tol": 0.25, "time_limit": 9.0, "node_limit": 77, "threads": 2},
        **{"polish": False},
    }
    assert {name: fake.called[name] for name in expected} == expected


def test_defaults(call, clouds, fake):
    assert run(*call).exit_code == 0
    assert fake.called["polish"] is True
    assert fake.called["threads"] == 1
    left_to_the_library = (
        *("scale_range", "mode", "bound", "gap_tol", "node_limit", "candidates"),
        "downsample",
    )
    assert [fake.called[name] for name in left_to_the_library] == [None] * 7
    assert fake.called["time_limit"] == DEFAULT_TIME_LIMIT_S


@pytest.mark.parametrize(("text", "pairs"), [("1", 1), ("1.0", 12), ("7", 7), ("0.5", 6)])
def test_count_or_fraction(clouds, fake, text, pairs):
    run("register", *clouds, "--model", "similarity2d", "--n-inliers", text)
    assert fake.called["n_inliers"] == pairs


def test_key_options(clouds, fake):
    source, target = clouds
    path = target.removesuffix(":a")
    arguments = ["register", source, path, "--model", "similarity2d", "--n-inliers", "3"]
    assert run(*arguments, "--target-key", "b").exit_code == 0
    assert len(fake.called["target"]) == 6
    assert "a, b; name one" in run(*arguments).stderr


def test_help_and_version():
    outcome = run("--help")
    assert outcome.exit_code == 0
    for command in ("register", "sweep", "verify", "version"):
        assert command in outcome.stdout
    outcome = run("version")
    assert outcome.exit_code == 0
    assert outcome.stdout.startswith(f"dcreg {dcreg.__version__}\npython 3.")
    outcome = run("--version")
    assert outcome.exit_code == 0
    assert outcome.stdout == f"dcreg {dcreg.__version__}\n"


def test_help_lists_what_is_accepted():
    text = " ".join(run("register", "--help").stdout.replace("│", "").split())
    for name in [*dcreg.bound_names(), *dcreg.mode_names("rigid3d"), *ModelChoice, *READERS]:
        assert name in text
    assert list(ModelChoice) == list(MODEL_DIM)
    assert "Equal numbers fix it" in text


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"--n-inliers": "lots"}, ["--n-inliers: 'lots'", "such as 40"]),
        ({"--n-inliers": "13"}, ["--n-inliers: 13", "between 1 and 12"]),
        ({"--n-inliers": "0"}, ["--n-inliers: 0"]),
        ({"--n-inliers": "1.5"}, ["--n-inliers", "1.5", "(0, 1]"]),
        ({"--n-inliers": "nan"}, ["--n-inliers", "nan"]),
        ({"--model": "rigid3d"}, ["source.txt", "2 coordinates", "use --model similarity2d"]),
        ({"--model": "affine"}, ["--model", "affine", "similarity2d", "rigid3d"]),
        ({"--scale-range": ("2", "1")}, ["--scale-range: (2.0, 1.0)", "low <= high"]),
        ({"--scale-range": ("nan", "1")}, ["--scale-range"]),
        ({"--bound": "magic"}, ["--bound: 'magic'", "tight"]),
        ({"--mode": "magic"}, ["--mode: 'magic'", "paper"]),
        ({"--gap-tol": "-1"}, ["--gap-tol: -1"]),
        ({"--gap-tol": "nan"}, ["--gap-tol: nan"]),
        ({"--time-limit": "0"}, ["--time-limit: 0"]),
        ({"--node-limit": "-3"}, ["--node-limit: -3"]),
        ({"--threads": "0"}, ["--threads: 0"]),
        ({"--threads": "two"}, ["--threads", "'two'", "whole number"]),
        ({"--node-limit": "1e3"}, ["--node-limit", "'1e3'", "whole number"]),
        ({"--time-limit": "1h"}, ["--time-limit", "'1h'", "not a number"]),
        ({"--scale-range": ("half", "1")}, ["--scale-range", "'half'", "not a number"]),
    ],
)
def test_bad_values_exit_2(clouds, change, words):
    options = {"--model": "similarity2d", "--n-inliers": "5"} | change
    arguments = ["register", *clouds]
    for name, value in options.items():
        arguments += [name, *([value] if isinstance(value, str) else value)]
    outcome = run(*arguments)
    assert outcome.exit_code == 2, outcome.output
    assert outcome.stdout == ""
    assert "Traceback" not in outcome.stderr
    for word in words:
        assert word in outcome.stderr


@pytest.mark.parametrize("which", [0, 1])
def test_bad_file_exits_2_and_names_it(call, tmp_path, fake, which):
    bad = tmp_path / "bad.csv"
    bad.write_text("1,2\n3,nan\n")
    call[1 + which] = bad
    outcome = run(*call)
    assert outcome.exit_code == 2
    assert outcome.stderr == f"error: {bad}: line 2 holds NaN or infinity; remove that point\n"
    assert fake.called is None


def test_candidates_are_read_as_pairs(call, tmp_path, fake):
    pairs = [[i, j] for i in range(12) for j in (i, (i + 1) % 12)]
    np.savetxt(tmp_path / "pairs.txt", pairs, fmt="%d")
    assert run(*call, "--candidates", tmp_path / "pairs.txt").exit_code == 0
    assert sorted(np.argwhere(fake.called["candidates"]).tolist()) == sorted(pairs)


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([[0.5, 1]], "not a table of pairs"),
        ([[12, 0]], "12 is no source row"),
        ([[0, 12]], "12 for source point 0 is no target index"),
        ([[0, 0]], "at most 1 pairs can be matched"),
    ],
)
def test_bad_candidates_exit_2(call, tmp_path, fake, pairs, words):
    np.savetxt(tmp_path / "pairs.txt", pairs)
    result = run(*call, "--candidates", tmp_path / "pairs.txt")
    assert result.exit_code == 2
    assert words in " ".join(result.stderr.split())
    assert fake.called is None


def test_candidates_reach_the_sweep(sweep_call, tmp_path, fake_sweep):
    pairs = [[i, j] for i in range(12) for j in (i, (i + 1) % 12)]
    np.savetxt(tmp_path / "pairs.txt", pairs, fmt="%d")
    assert run(*sweep_call, "--candidates", tmp_path / "pairs.txt").exit_code == 0
    lists = [sorted(columns) for columns in fake_sweep.called["candidates"]]
    assert lists == [sorted([i, (i + 1) % 12]) for i in range(12)]


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


def test_too_few_arguments_exit_2():
    outcome = run("register", "a.txt", "b.txt", "--model", "similarity2d")
    assert outcome.exit_code == 2
    assert "--n-inliers" in outcome.stderr


@pytest.mark.parametrize("option", ["--json", "--trace", "--plot"])
def test_unwritable_outputs_stop_before_the_search(call, clouds, tmp_path, fake, option):
    source, _ = clouds
    before = source.read_bytes()
    for path, words in [
        (tmp_path / "absent" / "out.html", ["no folder", "create it first"]),
        (tmp_path, ["not a plain file"]),
        (source, ["is an input as well"]),
        (source / "out", ["no folder"]),
    ]:
        outcome = run(*call, option, path)
        assert outcome.exit_code == 2
        assert f"{option} {path}" in outcome.stderr
        for word in words:
            assert word in outcome.stderr
    assert fake.called is None
    assert source.read_bytes() == before


def test_outputs_must_differ(call, tmp_path, fake):
    outcome = run(*call, "--json", tmp_path / "out", "--plot", tmp_path / "." / "out")
    assert outcome.exit_code == 2
    assert "is the file of --json as well" in outcome.stderr


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_write_permission(call, tmp_path, fake):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    outcome = run(*call, "--json", locked / "out.json")
    assert outcome.exit_code == 2
    assert "cannot write" in outcome.stderr


# --- results --------------------------------------------------------------------------------------


def test_outputs(call, tmp_path, fake):
    fake.lower_bound = -math.inf
    paths = [tmp_path / name for name in ("o.json", "o.jsonl", "o.html")]
    before = set(tmp_path.iterdir())
    outcome = run(*call, "--json", paths[0], "--trace", paths[1], "--plot", paths[2])
    assert outcome.exit_code == 0
    assert set(tmp_path.iterdir()) - before == set(paths)  # no half-written neighbours stay
    content = json.loads(paths[0].read_text(), parse_constant=pytest.fail)
    assert set(content) >= ISSUE_KEYS
    assert content["lower_bound"] is None  # infinite
    assert content["n_nodes"] == 7
    assert content["T_target_source"] == np.eye(3).tolist()
    kinds = [json.loads(line)["kind"] for line in paths[1].read_text().splitlines()]
    assert kinds == ["bound", "end"]
    assert "Plotly.newPlot" in paths[2].read_text()


def test_json_on_standard_output_stands_alone(call, fake):
    outcome = run(*call, "--json", "-")
    assert json.loads(outcome.stdout)["status"] == "optimal"
    assert "T_target_source" in outcome.stderr


@pytest.mark.parametrize(
    ("status", "code"),
    [
        *((Status.OPTIMAL, 0), (Status.CONVERGED, 0), (Status.TIME_LIMIT, 3)),
        *((Status.NODE_LIMIT, 3), (Status.MEMORY_LIMIT, 3), (Status.STOPPED, 3)),
    ],
)
def test_exit_code_by_status(call, tmp_path, fake, status, code):
    fake.status = status
    outcome = run(*call, "--gap-tol", "0.1", "--json", tmp_path / "o.json")
    assert outcome.exit_code == code
    assert json.loads((tmp_path / "o.json").read_text())["status"] == status.value
    assert status.value in outcome.stdout
    assert ("not certified" in outcome.stdout) == (status is not Status.OPTIMAL)


def test_summary_is_complete(call, fake):
    text = run(*call).stdout
    for name in ("T_target_source", "scale", "rotation", "lower bound", "upper bound", "gap"):
        assert name in text
    for value in ("similarity pose", "7 nodes, 112 assignments", "0.20 s solving", "RMSE"):
        assert value in text


def test_summary_tells_a_closed_stage_from_an_open_one(call, fake):
    fake.status = Status.TIME_LIMIT
    fake.stages = (
        Stage("search", 1.25, 5, 9, Status.OPTIMAL, 0.5, 1.0),
        Stage("rotation", 1.25, 5, 9, Status.TIME_LIMIT, 2.0, 9.0),
        Stage("polish", 0.0, objective_before=9.0, objective_after=1.0),
    )
    text = " ".join(run(*call, "--gap-tol", "0.6").stdout.split())
    assert "time_limit: best pose so far; certified for the similarity pose, but a later" in text
    assert "search stage optimal, bounds [0.5, 1], 5 nodes, 1.25 s" in text
    assert "rotation stage time_limit, bounds [2, 9]" in text
    assert "not certified" in run(*call, "--gap-tol", "0.4").stdout


def test_full_disk_is_reported_after_the_pose(call, tmp_path, fake, monkeypatch):
    """A real write failure: files may not grow beyond 100 bytes once the search is over."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    path = tmp_path / "o.json"
    path.write_text("earlier result")
    summary = Result.summary

    def summary_then_limit(result):
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, old[1]))
        return summary(result)

    monkeypatch.setattr(Result, "__str__", summary_then_limit)
    try:
        outcome = run(*call, "--json", path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert outcome.exit_code == 1
    assert "T_target_source" in outcome.stdout
    assert f"error: cannot write {path}: File too large" in outcome.stderr
    assert path.read_text() == "earlier result"
    assert not list(tmp_path.glob(".*.part"))


# --- advice ---------------------------------------------------------------------------------------


def test_advice_speaks_of_what_is_searched(tmp_path, monkeypatch):
    """Of large clouds, but not where some of their points are searched; of units; never when quiet."""
    monkeypatch.setattr(sys.modules["dcreg.diagnostics"], "_MANY_POINTS", 40)
    cloud = np.random.default_rng(0).random((45, 3))
    np.save(tmp_path / "a.npy", cloud)
    np.save(tmp_path / "b.npy", 1000 * cloud[:30])
    arguments = ["register", tmp_path / "a.npy", tmp_path / "b.npy", "--model", "rigid3d"]
    arguments += ["--n-inliers", "20", "--time-limit", "0.5"]
    whole = run(*arguments).stderr
    assert "warning: 45 x 30 points" in whole
    assert "--downsample 200" in whole
    assert "hint: the RMS radii differ a lot" in whole
    some = run(*arguments, "--downsample", "15").stderr
    assert "warning: 45 x 30 points" not in some
    assert "hint: the RMS radii differ a lot" in some
    assert run(*arguments, "--quiet").stderr == ""


def test_no_advice_without_reason(call):
    outcome = run(*call)
    assert "hint" not in outcome.stderr
    assert "points. Each exact assignment" not in outcome.stderr


# --- progress -------------------------------------------------------------------------------------


def show(events, *, terminal=False, **options):
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, width=80)
    with Progress(console, **options) as progress:
        for each in events:
            assert progress(each) is False
    return stream.getvalue()


def test_plain_lines_are_few_aligned_and_end_with_the_last_event():
    events = [event(time_s=i / 100, n_nodes=i + 1, upper=9.0 - i % 2) for i in range(50)]
    events.append(event("end", time_s=0.5, n_nodes=99, upper=0.125, status="optimal"))
    lines = show(events, gap_tol=0.5).splitlines()
    assert "gap 0.5" in lines[0]
    assert lines[1].startswith("* better pose")
    header, first, last = lines[2:]
    assert first.startswith("* search")
    assert last.startswith("* search")
    assert last.split()[2:] == ["99", "3", "1584", "0", "0.125", "0.125", "0.5s", "optimal"]
    for column in ("nodes", "lower bound", "upper bound", "gap", "time"):
        end = header.index(column) + len(column)
        assert first[end - 1] != " "
        assert first[end : end + 1] in ("", " ")
    assert max(map(len, (header, first))) <= 80


def test_infinite_bounds_and_new_stage_marks():
    events = [event(lower=-math.inf, upper=math.inf), event("end", upper=1.0)]
    events.append(event("end", stage="rotation", upper=5.0))
    first, second, third = show(events).splitlines()[3:]
    assert first.split() == ["search", "1", "3", "16", "-", "-", "-", "0.0s"]
    assert second.startswith("*")
    assert third.startswith("* rotation")  # a larger value, but of another objective


def test_the_last_event_is_shown_even_without_an_end():
    lines = show([event(n_nodes=1), event(n_nodes=2), event(n_nodes=3)]).splitlines()
    assert [line.split()[-7] for line in lines[3:]] == ["1", "3"]


def test_terminal_shows_one_live_line():
    text = show([event(n_nodes=n) for n in (41, 42, 43)], terminal=True)
    assert "search            43" in text
    assert "\x1b[" in text  # redrawn in place


def test_messages_of_the_library_are_shown_while_it_works():
    stream = io.StringIO()
    log = logging.getLogger("dcreg.driver.warm_up")
    level = logging.getLogger("dcreg").level
    with Progress(Console(file=stream)):
        log.info("compiling %s (once; about %d s)", "[kernels]", 9)
    log.info("too late")
    with Progress(Console(file=stream), quiet=True):
        log.info("not asked for")
    assert stream.getvalue() == "compiling [kernels] (once; about 9 s)\n"
    assert logging.getLogger("dcreg").level == level


def test_quiet_shows_nothing():
    assert show([event("end")], quiet=True) == ""


def test_interrupt_asks_to_stop_then_quits_and_restores_the_handler():
    before = signal.getsignal(signal.SIGINT)
    with Progress(Console(file=io.StringIO())) as progress:
        assert progress(event()) is False
        signal.raise_signal(signal.SIGINT)
        assert progress(event()) is True
        with pytest.raises(KeyboardInterrupt, match="nothing is written"):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_proof_progress_goes_on_while_a_step_takes_long():
    stream = io.StringIO()
    with ProofProgress(Console(file=stream), interval_s=0.01) as progress:
        time.sleep(0.2)
        progress(64, 200)
        time.sleep(0.2)
        progress(300, 200)  # more than were known to be needed
        time.sleep(0.2)
    lines = stream.getvalue().splitlines()
    assert lines.count("checking what the certificate states, 0 s") >= 2
    assert lines.count("proving the bounds: 64 of 200 boxes, 0 s") >= 2
    assert lines.count("proving the bounds: 300 of 300 boxes, 0 s") >= 1
    n_threads = threading.active_count()
    stream = io.StringIO()
    with ProofProgress(Console(file=stream), interval_s=60.0) as progress:
        assert threading.active_count() == n_threads + 1
        progress(64, 200)
    assert stream.getvalue() == ""
    assert threading.active_count() == n_threads


def test_proof_progress_on_a_terminal_is_one_line_and_quiet_is_none():
    stream = io.StringIO()
    terminal = Console(file=stream, force_terminal=True, width=80)
    with ProofProgress(terminal) as progress:
        progress(1, 1)
    assert "proving the bounds: 1 of 1 box" in stream.getvalue()
    assert "boxes" not in stream.getvalue()
    stream = io.StringIO()
    with ProofProgress(Console(file=stream, force_terminal=True), quiet=True) as progress:
        progress(64, 200)
    assert stream.getvalue() == ""


def test_progress_works_outside_the_main_thread():
    texts = []
    thread = threading.Thread(target=lambda: texts.append(show([event("end")])))
    thread.start()
    thread.join()
    assert "search" in texts[0]


# --- the real search ------------------------------------------------------------------------------


def test_real_registration_2d(clouds, tmp_path):
    outcome = run(
        *("register", *clouds, "--model", "similarity2d", "--n-inliers", "1.0"),
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
    outcome = run(*hard_case(tmp_path), "--node-limit", "40")
    assert outcome.exit_code == 3
    content = json.loads((tmp_path / "o.json").read_text())
    assert content["status"] == "node_limit"
    assert np.isfinite(content["T_target_source"]).all()


def hard_case(folder):
    """Two unrelated clouds and no tolerance: a search that does not end by itself."""
    generator = np.random.default_rng(8)
    for name in ("a.txt", "b.txt"):
        np.savetxt(folder / name, generator.random((60, 2)))
    return [
        *("register", folder / "a.txt", folder / "b.txt", "--model", "similarity2d"),
        *("--n-inliers", "0.5", "--gap-tol", "0", "--time-limit", "120"),
        *("--json", folder / "o.json"),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_process_keeps_the_pose(tmp_path, number):
    command = [sys.executable, "-m", "dcreg", *map(str, hard_case(tmp_path))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    watchdog = threading.Timer(180, process.kill)
    watchdog.start()
    try:
        lines = []
        for line in process.stderr:  # plain lines in a pipe
            lines.append(line)
            if line[2:].startswith("search "):
                break
        time.sleep(0.2)
        process.send_signal(number)
        stdout, rest = process.communicate()
    finally:
        watchdog.cancel()
        process.kill()
    assert process.returncode == 3, "".join(lines) + rest
    assert "stopped: best pose so far" in stdout
    assert "Traceback" not in rest
    assert json.loads((tmp_path / "o.json").read_text())["status"] == "stopped"


def test_written_certificate_is_verified_and_a_damaged_one_refused(tmp_path):
    points = np.random.default_rng(5).random((12, 2))
    np.savetxt(tmp_path / "a.txt", points)
    np.savetxt(tmp_path / "b.txt", points + 0.01 * np.random.default_rng(6).random((12, 2)) + 3.0)
    a, b, proof = (str(tmp_path / name) for name in ("a.txt", "b.txt", "proof.npz"))
    runner = CliRunner()
    arguments = ["register", a, b, "--model", "similarity2d", "--n-inliers", "12"]
    for tolerance, said in (([], "holds, but says nothing:"), (["--tol", "0.0005"], "proven:")):
        made = runner.invoke(app, [*arguments, *tolerance, "--certificate", proof])
        assert made.exit_code == 0
        accepted = runner.invoke(app, ["verify", proof, a, b])
        assert accepted.exit_code == 0
        assert said in accepted.output
    refused = runner.invoke(app, ["verify", proof, b, a])
    assert refused.exit_code == 1
    assert "refused:" in refused.output
    whole = (tmp_path / "proof.npz").read_bytes()
    (tmp_path / "proof.npz").write_bytes(whole[: len(whole) // 2])
    assert runner.invoke(app, ["verify", proof, a, b]).exit_code == 1
    assert runner.invoke(app, ["verify", str(tmp_path / "none.npz"), a, b]).exit_code == 2


# --- sweep ----------------------------------------------------------------------------------------


@pytest.fixture
def sweep_call(clouds):
    return ["sweep", *clouds, "--model", "similarity2d", "--n-inliers", "6:12:3"]


@pytest.fixture
def fake_sweep(monkeypatch):
    """`dcreg.sweep` replaced by one that records its arguments and returns at once."""

    class Fake:
        statuses = (Status.OPTIMAL, Status.OPTIMAL, Status.OPTIMAL)
        called = None

        def __call__(self, source, target, n_inliers, **options):
            self.called = {"n_inliers": n_inliers, **options}
            results = [
                Result(
                    status=status,
                    model=options["model"],
                    mode="paper",
                    bound="tight",
                    T_target_source=np.eye(3),
                    T_certified=np.eye(3),
                    assignment=np.array([[0, 0]]),
                    n_inliers=k,
                    lower_bound=0.5 * value,
                    upper_bound=value,
                    gap_tol=0.1,
                    certificate_scope="similarity pose",
                    objective=value,
                    objective_certified=value,
                    n_nodes=np.int64(7),
                    n_assignments=112,
                    time_setup_s=0.1,
                    time_solve_s=0.2,
                    trace=Trace(),
                )
                for k, value, status in zip(
                    (6, 9, 12), (0.06, 0.09, 3.0), self.statuses, strict=True
                )
            ]
            return SweepResult(results, [None, 9, 9])

    made = Fake()
    monkeypatch.setattr(dcreg, "sweep", made)
    return made


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        ("6:12:3", [6, 9, 12]),
        ("6:8", [6, 7, 8]),
        ("6:11:3", [6, 9]),
        ("0.3:1.0:0.1", [0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]),
        ("0.5, 7 ,1.0", [0.5, 7, 1.0]),
        ("0.8:1.0:0.1,4", [0.8, 0.9, 1.0, 4]),
        ("7", [7]),
        (",", []),
    ],
)
def test_sweep_lists_and_ranges(clouds, fake_sweep, text, counts):
    run("sweep", *clouds, "--model", "similarity2d", "--n-inliers", text)
    assert fake_sweep.called["n_inliers"] == counts
    assert list(map(type, fake_sweep.called["n_inliers"])) == list(map(type, counts))


def test_sweep_options_reach_the_library(sweep_call, fake_sweep):
    outcome = run(
        *(*sweep_call, "--scale-range", 0.9, 1.1, "--bound", "interval", "--gap-tol", 0.25),
        *("--time-limit", 9, "--node-limit", 77, "--threads", 2, "--no-polish", "--downsample", 50),
    )
    assert outcome.exit_code == 0
    expected = {
        **{
            "model": "similarity2d",
            "scale_range": (0.9, 1.1),
            "bound": "interval",
            "gap_tol": 0.25,
        },
        **{"time_limit": 9.0, "node_limit": 77, "threads": 2, "polish": False, "downsample": 50},
    }
    assert {name: fake_sweep.called[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"--n-inliers": "0.3:1:0.1"}, ["--n-inliers", "mixes counts and fractions"]),
        ({"--n-inliers": "0.3:1.0"}, ["--n-inliers: '0.3:1.0'", "FROM:TO:STEP"]),
        ({"--n-inliers": "9:6:1"}, ["--n-inliers: '9:6:1'", "FROM <= TO"]),
        ({"--n-inliers": "6:9:0"}, ["--n-inliers: '6:9:0'", "STEP > 0"]),
        ({"--n-inliers": "0.1:nan:0.1"}, ["--n-inliers", "nan"]),
        ({"--n-inliers": "1:2:3:4"}, ["--n-inliers: '1:2:3:4'", "FROM:TO:STEP"]),
        ({"--n-inliers": "0.1:1.0:0.00001"}, ["--n-inliers", "at most 1000"]),
        ({"--n-inliers": "6,lots"}, ["--n-inliers: 'lots'", "such as 40"]),
        ({"--n-inliers": ","}, ["--n-inliers", "empty"]),
        ({"--n-inliers": "6,13"}, ["--n-inliers: 13", "between 1 and 12"]),
        ({"--bound": "magic"}, ["--bound: 'magic'"]),
        ({"--time-limit": "0"}, ["--time-limit: 0"]),
        ({"--downsample": "1"}, ["--downsample: 1", "such as 200"]),
        ({"--out": "a.xlsx"}, ["--out a.xlsx", ".json, .csv"]),
        ({"--plot": "a.pdf"}, ["--plot a.pdf", ".html, .png, .svg"]),
        ({"--plot": "missing/a.html"}, ["--plot missing/a.html", "no folder"]),
    ],
)
def test_sweep_bad_values_exit_2(clouds, change, words):
    options = {"--model": "similarity2d", "--n-inliers": "6"} | change
    outcome = run("sweep", *clouds, *(text for pair in options.items() for text in pair))
    assert outcome.exit_code == 2, outcome.output
    assert outcome.stdout == ""
    assert "Traceback" not in outcome.stderr
    for word in words:
        assert word in outcome.stderr


def test_sweep_images_need_matplotlib_only(sweep_call, fake_sweep, tmp_path, monkeypatch):
    found = output.find_spec
    without = lambda name: None if name == "seaborn" else found(name)  # noqa: E731
    monkeypatch.setattr(output, "find_spec", without)
    outcome = run(*sweep_call, "--plot", tmp_path / "a.png")
    assert outcome.exit_code == 2
    assert ".png files need seaborn; install with: pip install seaborn" in outcome.stderr
    assert fake_sweep.called is None
    assert run(*sweep_call, "--plot", tmp_path / "a.html").exit_code == 0


def test_sweep_limit_exits_3_and_still_writes(sweep_call, fake_sweep, tmp_path):
    fake_sweep.statuses = (Status.OPTIMAL, Status.TIME_LIMIT, Status.OPTIMAL)
    outcome = run(*sweep_call, "--out", tmp_path / "a.json")
    assert outcome.exit_code == 3
    assert "time_limit" in outcome.stdout
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["status"] == "time_limit"
    assert [row["status"] for row in content["table"]] == ["optimal", "time_limit", "optimal"]


def test_sweep_unwritable_output_exits_1(sweep_call, fake_sweep, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(SweepResult, "write_csv", fail)
    outcome = run(*sweep_call, "--out", tmp_path / "a.csv")
    assert outcome.exit_code == 1
    assert "No space left" in outcome.stderr
    assert "similarity pose" in outcome.stdout
    assert list(tmp_path.glob("*a.csv*")) == []


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
    assert (last["n_inliers"], last["status"], last["next_pair"]) == ("12", "optimal", "")
    pose = [[float(last[f"T{i}{j}"]) for j in range(3)] for i in range(3)]
    expected = [1.2 * np.cos(0.4), -1.2 * np.sin(0.4), 5.0]
    np.testing.assert_allclose(pose[0], expected, atol=1e-6)
    assert (tmp_path / "a.svg").read_text().lstrip().startswith("<?xml")


def test_sweep_help_has_an_example():
    outcome = run("sweep", "--help")
    assert outcome.exit_code == 0
    assert "dcreg sweep a.txt b.txt" in outcome.stdout


# --- what the library decides -----------------------------------------------------------------------


def test_default_tolerance_of_a_target_without_extent(tmp_path):
    """Its unit of length is then the source's, so the tolerance is that of the library, not zero."""
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


def test_equal_ends_of_the_scale_range_fix_the_scale(clouds, tmp_path):
    command = ["register", *clouds, "--model", "similarity2d", "--n-inliers", "12"]
    outcome = run(*command, "--scale-range", 1, 1, "--json", tmp_path / "o.json")
    assert outcome.exit_code == 0, outcome.output
    content = json.loads((tmp_path / "o.json").read_text())
    assert content["status"] == "optimal"
    assert content["scale"] == pytest.approx(1.0, abs=1e-12)  # 1.2 without the constraint
    assert content["objective"] > 0.01


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--mode", "full", "--bound", "dc"], "--bound: 'dc', but mode 'full' has bounds"),
        (["--scale-range", "0.9", "1.1"], "--scale-range: (0.9, 1.1), but rigid3d has no scale"),
        (["--mode", "full", "--certificate", "c.npz"], "--certificate: mode 'full' keeps no leaf"),
        (["--mode", "best"], "--mode: 'best' is unknown for rigid3d"),
    ],
)
def test_what_a_mode_would_ignore_is_refused(tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    np.savetxt("a.txt", np.random.default_rng(3).random((6, 3)))
    np.savetxt("b.txt", np.random.default_rng(4).random((6, 3)))
    outcome = run("register", "a.txt", "b.txt", "--model", "rigid3d", "--n-inliers", 6, *options)
    assert outcome.exit_code == 2
    assert words in outcome.stderr
    assert outcome.stdout == ""


def test_the_command_prints_what_the_result_prints(call, fake):
    printed = run(*call).stdout
    source, target = fake.called.pop("source"), fake.called.pop("target")
    assert printed == f"{fake(source, target, **fake.called)}\n"


@pytest.mark.parametrize(("more", "pairs"), [([], 9), (["--downsample", "5"], 4)])
def test_a_tolerance_as_a_length(call, more, pairs):
    """Of the pairs that are searched."""
    found = json.loads(run(*call, "--tol", "0.1", "--json", "-", *more).stdout)
    assert found["gap_tol"] == pytest.approx(pairs * 0.01)


def test_no_tolerance_is_warned_of(call, fake):
    assert "--gap-tol 0: a gap hardly ever closes" in run(*call, "--gap-tol", "0").stderr
    assert "hardly ever" not in run(*call, "--gap-tol", "0.1").stderr


# --- signals before a search ------------------------------------------------------------------------

NOTHING = "interrupted: there is no result, and nothing is written"


def ends_within_2_s(process, number):
    """Exit code and last line on standard error of a process that is sent a signal."""
    used = psutil.Process(process.pid).cpu_times()
    others = resource.getrusage(resource.RUSAGE_CHILDREN)
    process.send_signal(number)
    _, messages = process.communicate(timeout=15)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - others.ru_utime - others.ru_stime
    # of the processor, which other work on the machine does not prolong: 15 s of the clock
    assert spent - used.user - used.system <= 2.0
    assert "Traceback" not in messages
    return process.returncode, messages.splitlines()[-1]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_while_a_file_is_read_ends_at_once(tmp_path, number, code):
    os.mkfifo(tmp_path / "slow.txt")
    np.savetxt(tmp_path / "a.txt", np.eye(2))
    command = [sys.executable, "-m", "dcreg", "register", tmp_path / "slow.txt", tmp_path / "a.txt"]
    process = subprocess.Popen(
        [*map(str, command), "--model", "similarity2d", "--n-inliers", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    with (tmp_path / "slow.txt").open("w") as slow:  # waits for the reader
        assert ends_within_2_s(process, number) == (code, NOTHING)
        assert not slow.closed


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_while_kernels_are_compiled_ends_at_once(call, tmp_path, number, code):
    process = subprocess.Popen(
        [sys.executable, "-m", "dcreg", *map(str, call)],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cold")},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr.readline().startswith("compiling the kernels")
    assert ends_within_2_s(process, number) == (code, NOTHING)


@pytest.mark.parametrize("error", [RuntimeError("reentrant call"), BrokenPipeError()])
def test_a_command_that_was_printing_ends_at_once(monkeypatch, capfd, error):
    class Interrupted(io.StringIO):
        def flush(self):
            raise error

    ended = []
    monkeypatch.setattr(sys, "stdout", Interrupted())
    monkeypatch.setattr(os, "_exit", ended.append)
    leave(Interrupt(signal.SIGTERM))
    assert ended == [143]
    monkeypatch.undo()
    assert capfd.readouterr().err == f"{NOTHING}\n"


def test_a_signal_before_the_search_ends_the_preparation():
    with Progress(Console(file=io.StringIO())) as progress, pytest.raises(Interrupt, match=NOTHING):
        signal.raise_signal(signal.SIGTERM)
    assert not progress.stop_requested


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_file_is_written_leaves_no_half_of_it(tmp_path, number):
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        raise_again()
        with (  # noqa: PT012
            pytest.raises(Interrupt, match="printed above"),
            whole_file(tmp_path / "a") as part,
        ):
            part.write_text("half")
            signal.raise_signal(number)
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("terminal", [True, False])
def test_time_of_the_preparation_is_shown(monkeypatch, terminal):
    monkeypatch.setattr("dcreg.cli.progress._WAITING_S", 0.3)

    def prepare_and_search(progress):
        time.sleep(0.5)
        progress(event("end"))
        time.sleep(0.5)
        return 7

    for quiet in (False, True):
        stream = io.StringIO()
        console = Console(file=stream, force_terminal=terminal, width=80)
        with Progress(console, quiet=quiet) as progress:
            assert progress.run(lambda: prepare_and_search(progress)) == 7
        assert ("preparing the search, 0 s" in stream.getvalue()) != quiet
        if not (quiet or terminal):
            assert stream.getvalue().count("preparing") == 1  # and not while it searches
