"""One run at a time in a folder of results, and Snakemake as a process of its own."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import IO, Self

import pytest

from workflows import running
from workflows.running import INTERRUPTED, BusyError, _correct_times, run_snakemake, the_only_run


def test_the_message_to_a_second_run_names_the_first(tmp_path):
    with the_only_run(tmp_path, "a"):
        with (
            pytest.raises(BusyError, match=f"another run uses .*: process {os.getpid()}, since 2"),
            the_only_run(tmp_path, "a"),
        ):
            pass
        with the_only_run(tmp_path, "b"):  # another experiment
            pass
    with the_only_run(tmp_path, "a"):  # the first has ended
        pass


def test_what_a_killed_run_left_behind_is_no_lock(tmp_path):
    folder = tmp_path / "results" / "a"
    folder.mkdir(parents=True)
    (folder / "run.lock").write_text("process 1, since yesterday\n")
    with the_only_run(tmp_path, "a"):
        assert f"process {os.getpid()}, " in (folder / "run.lock").read_text()


def test_a_lock_of_a_snakemake_started_by_hand_is_named_with_a_remedy(tmp_path):
    lock = tmp_path / ".snakemake" / "locks" / "0.output.lock"
    lock.parent.mkdir(parents=True)
    lock.write_text("results/a/plan/plan.parquet\n")
    with (
        pytest.raises(BusyError, match=r"started manually .*0\.output\.lock.*snakemake --unlock"),
        the_only_run(tmp_path, "a"),
    ):
        pass
    with the_only_run(tmp_path, "ab"):  # on other files than this lock's
        pass


def test_files_from_the_future_get_the_present_time(tmp_path):
    """As after the clock was set back; Snakemake refuses files that are older than their input."""
    now = time.time()
    times = {"later": now + 1e6, "earlier": now - 1e6}
    for name, moment in times.items():
        path = tmp_path / "runs" / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
        os.utime(path, (moment, moment))
    _correct_times(tmp_path)
    assert now <= (tmp_path / "runs" / "later").stat().st_mtime <= time.time()
    assert (tmp_path / "runs" / "earlier").stat().st_mtime == pytest.approx(now - 1e6)


def test_snakemake_is_stopped_at_the_given_time(tmp_path, monkeypatch):
    """Also if that time is over before it starts: a signal to this process would end it then."""
    monkeypatch.setattr("snakemake.cli.main", lambda words: time.sleep(20))
    began = time.monotonic()
    before = signal.signal(signal.SIGTERM, lambda *_: None)  # of this process only
    try:
        assert run_snakemake(tmp_path, "a", ["--config"], end=began) == INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, before)
    assert time.monotonic() < began + 10.0


class Following:
    """A view on a terminal that keeps what it is shown."""

    is_live = True

    def __init__(self, error: type[Exception] | None = None) -> None:
        self.lines: list[str] = []
        self.error = error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def follow(self, output: IO[str]) -> threading.Thread:
        def copy() -> None:
            with output:
                self.lines.extend(output)

        thread = threading.Thread(target=copy)
        thread.start()
        return thread

    def update(self) -> None:
        if self.error:
            raise self.error


def test_snakemake_has_streams_of_its_own(tmp_path, monkeypatch):
    """Its messages go to the view, and it reads nothing that was meant for others."""

    def shows(words: list[str]) -> None:
        print(f"read {os.read(0, 9)!r}")
        print("of \udcff", file=sys.stderr)
        raise SystemExit(3)

    monkeypatch.setattr("snakemake.cli.main", shows)
    view = Following()
    assert run_snakemake(tmp_path, "a", ["--config"], view_of=lambda: view) == 3
    assert view.lines == ["read b''\n", "of \\udcff\n"]


def test_snakemake_ends_if_nobody_reads_its_messages(tmp_path, monkeypatch):
    monkeypatch.setattr("snakemake.cli.main", lambda words: print("x" * 10**6, flush=True))
    reader, writer = os.pipe()
    process = running._context.Process(target=running._snakemake, args=([], None, (reader, writer)))
    process.start()
    os.close(reader)
    os.close(writer)
    process.join(timeout=20)
    assert process.exitcode == 1  # BrokenPipeError


def test_an_error_of_the_view_ends_snakemake(tmp_path, monkeypatch):
    monkeypatch.setattr("snakemake.cli.main", lambda words: time.sleep(60))
    with pytest.raises(BrokenPipeError):
        run_snakemake(tmp_path, "a", ["--config"], view_of=lambda: Following(BrokenPipeError))
    end = time.monotonic() + 20
    while running.multiprocessing.active_children():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_snakemake_leaves_no_copies_of_the_rules(tmp_path, monkeypatch):
    def keeps(words: list[str]) -> None:
        folder = Path(words[words.index("--runtime-source-cache-path") + 1])
        (folder / "rule").write_text("x")

    monkeypatch.setattr("snakemake.cli.main", keeps)
    assert run_snakemake(tmp_path, "a", ["--config"]) == 0
    assert not list((tmp_path / "results" / "a").glob(".sources-*"))
