"""One run at a time in a folder of results; the lock goes with the process that holds it."""

from __future__ import annotations

import os
import time

import pytest

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
    assert run_snakemake(tmp_path, "a", ["--config"], end=began) == INTERRUPTED
    assert time.monotonic() < began + 10.0
