"""Progress lines, Ctrl-C and SIGTERM, while a search runs and outside of it."""

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
from dataclasses import replace

import numpy as np
import psutil
import pytest
from rich.console import Console

from dcreg.cli.interrupts import Interrupt, leave, raise_again
from dcreg.cli.progress import Progress
from dcreg.files import whole_file
from tests.results import event


def show(events, *, terminal=False, **options):
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, width=80)
    with Progress(console, **options) as progress:
        for each in events:
            assert progress(each) is False
    return stream.getvalue()


def test_plain_lines_are_few_aligned_and_end_with_the_last_event():
    events = [event(time_s=i / 100, n_nodes=i + 1, upper=9.0 - i % 2) for i in range(50)]
    events.append(event("end", time_s=0.5, n_nodes=99, lower=0.1, upper=0.125, status="optimal"))
    lines = show(events).splitlines()
    assert lines[0].startswith("pose at: time of the best pose")
    assert lines[1] == "proven: lower bound in % of the upper bound"
    assert lines[2].startswith("*: better pose")
    header, first, last = lines[3:]
    assert first.startswith("* search")
    assert last.startswith("* search")
    assert last.split()[2:] == ["99", "3", "0.5s", "0.1", "0.125", "80.0", "%", "0.5s", "optimal"]
    for column in ("nodes", "pose at", "lower bound", "upper bound", "proven", "time"):
        end = header.index(column) + len(column)
        assert first[end - 1] != " "
        assert first[end : end + 1] in ("", " ")
    assert max(map(len, (header, first))) <= 80


def test_infinite_bounds_and_new_stage_marks():
    events = [event(lower=-math.inf, upper=math.inf), event("end", upper=1.0)]
    events.append(event("end", stage="rotation", upper=5.0))
    first, second, third = show(events).splitlines()[4:]
    assert first.split() == ["search", "1", "3", "-", "-", "-", "0.0", "%", "0.0s"]
    assert second.startswith("*")
    assert third.startswith("* rotation")  # a larger value, but of another objective


def test_a_stage_that_keeps_the_pose_is_not_marked():
    events = [event(upper=2.0), event(stage="triples", upper=2.0), event(upper=2.0)]
    lines = show([*events, event(upper=1.0)], interval_s=-1.0).splitlines()[4:]
    assert [line[0] for line in lines] == ["*", " ", " ", "*"]


def test_the_last_event_is_shown_even_without_an_end():
    lines = show([event(n_nodes=1), event(n_nodes=2), event(n_nodes=3)]).splitlines()
    assert [line.split()[-8] for line in lines[4:]] == ["1", "3"]


def test_an_exact_fit_is_called_so():
    last = show([event("end", upper=1e-20, status="optimal")]).splitlines()[-1]
    assert last.split()[-4:] == ["exact", "fit", "0.0s", "optimal"]


def test_the_pose_counts_as_found_until_its_bound_falls_by_a_thousandth():
    uppers = [math.inf, 2.0, 1.999, 1.0, 0.9999, 0.9995]
    events = [event(time_s=float(at), upper=upper) for at, upper in enumerate(uppers)]
    events.append(event("end", time_s=9.0, stage="all points", upper=0.9995))  # the same pose
    events.append(event(time_s=9.4, stage="rotation", upper=math.inf))
    events.append(event("end", time_s=9.5, stage="rotation", upper=7.0))
    lines = show(events, interval_s=-1.0).splitlines()[4:]
    found = [line[29:38].strip() for line in lines]
    assert found == ["-", "1.0s", "1.0s", "3.0s", "3.0s", "3.0s", "3.0s", "-", "9.5s"]


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.parametrize(
    ("expected_s", "note"),
    [
        (11.2, "proof expected in about 12 s"),
        (math.inf, "proof not expected in time"),
        (None, ""),
    ],
)
def test_the_time_to_the_proof_is_shown_if_it_is_known(expected_s, note, terminal):
    text = show([replace(event(), expected_s=expected_s)], terminal=terminal)
    assert note in text
    assert ("proof" in text) == bool(note)


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
        with pytest.raises(KeyboardInterrupt, match="nothing was written"):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("terminal", [True, False])
def test_a_proof_shows_its_steps(monkeypatch, terminal):
    monkeypatch.setattr("dcreg.cli.progress._WAITING_S", 0.05)

    def prove(progress):
        time.sleep(0.3)
        for done in (64, 300):  # 300 are more than the 200 known to be needed
            progress.prove(done, 200)
            time.sleep(0.3)

    for quiet in (False, True):
        stream = io.StringIO()
        console = Console(file=stream, force_terminal=terminal, width=80)
        with Progress(console, quiet=quiet, step="checking") as progress:
            progress.run(lambda: prove(progress))
        for step in ("checking", "proving the bounds: 64 of 200 boxes", "300 of 300 boxes"):
            assert (step in stream.getvalue()) != quiet


def test_progress_works_outside_the_main_thread():
    texts = []
    thread = threading.Thread(target=lambda: texts.append(show([event("end")])))
    thread.start()
    thread.join()
    assert "search" in texts[0]


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


def test_a_search_without_news_is_shown_to_work(monkeypatch):
    """It compiles, or it finishes after its time limit."""
    monkeypatch.setattr("dcreg.cli.progress._WAITING_S", 0.2)
    monkeypatch.setattr("dcreg.cli.progress._SILENT_S", 0.2)
    stream = io.StringIO()

    def search(progress):
        progress(event())
        time.sleep(0.8)
        progress(event("end"))

    with Progress(Console(file=stream, width=80)) as progress:
        progress.run(lambda: search(progress))
    assert "compiling or finishing, 0 s" in stream.getvalue()


# --- signals before a search ------------------------------------------------------------------------

NOTHING = "interrupted: there is no result, and nothing was written"


def ends_within_2_s(process, number):
    """Send a signal to a process; return its exit code and its last line on standard error."""
    used = psutil.Process(process.pid).cpu_times()
    others = resource.getrusage(resource.RUSAGE_CHILDREN)
    process.send_signal(number)
    _, messages = process.communicate(timeout=15)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - others.ru_utime - others.ru_stime
    # CPU time, which does not depend on other work on the machine; 15 s of wall time
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
def test_a_signal_while_a_file_is_written_leaves_no_partial_file(tmp_path, number):
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


# --- signals during a search -------------------------------------------------------------------------


def hard_case(folder):
    """Two unrelated clouds and a tolerance of zero: the search does not close."""
    generator = np.random.default_rng(8)
    for name in ("a.txt", "b.txt"):
        np.savetxt(folder / name, generator.random((60, 2)))
    return [
        *("register", folder / "a.txt", folder / "b.txt", "--model", "similarity2d"),
        *("--n-inliers", "0.5", "--rel-gap", "0", "--time-limit", "120"),
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
