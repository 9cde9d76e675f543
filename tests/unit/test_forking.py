"""Stages that start and end at the same time in several threads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from workflows import records
from workflows.config import load
from workflows.forking import StageError, run_stage
from workflows.stages.plan import expand

STAGES = """
import threading
from workflows import forking

forking._context.set_forkserver_preload([])

def run():
    for _ in range(60):
        forking.run_stage("stage")

threads = [threading.Thread(target=run) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""


def test_no_stage_of_many_threads_is_said_to_fail(tmp_path):
    stage = tmp_path / "stage" / "__main__.py"
    stage.parent.mkdir()
    stage.write_text("def app(arguments): pass")
    path = os.pathsep.join([str(Path(__file__).parents[2]), str(tmp_path)])
    done = subprocess.run(
        [sys.executable, "-c", STAGES], env=os.environ | {"PYTHONPATH": path},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0
    assert "StageError" not in done.stderr


def test_a_stage_that_fails_is_reported():
    with pytest.raises(StageError, match="nothing"):
        run_stage("nothing")


def test_a_stage_does_not_read_the_config_again(tmp_path):
    plan = expand(load("demo"))
    run_stage(
        "workflows", "plan", "no_such_config", "--out", str(tmp_path / "plan.parquet"), plan=plan
    )
    table = records.read(tmp_path / "plan.parquet", records.PLAN)
    assert set(table["run_id"]) == {run.run_id for run in plan.runs()}


FORKED = """
import multiprocessing, os
from workflows import forking

forking.run_stage("stage", str(os.getpid()))  # starts the server of this process

def run():
    forking.forget_server()
    forking.run_stage("stage", str(os.getpid()))

process = multiprocessing.get_context("fork").Process(target=run)
process.start()
process.join()
raise SystemExit(process.exitcode)
"""
LOADED = """
import os, sys
import psutil

def app(arguments):
    owner = psutil.Process(os.getppid()).ppid()  # of the server
    sys.exit("workflows.preload" not in sys.modules or owner != int(arguments[0]))
"""


def test_a_forked_process_has_a_server_of_its_own_with_all_imports(tmp_path):
    stage = tmp_path / "stage" / "__main__.py"
    stage.parent.mkdir()
    stage.write_text(LOADED)
    path = os.pathsep.join([str(Path(__file__).parents[2]), str(tmp_path)])
    done = subprocess.run(
        [sys.executable, "-c", FORKED], env=os.environ | {"PYTHONPATH": path},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
