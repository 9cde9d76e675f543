"""A lost worker gives one run its status and affects no other run."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from baselines.contract import Instance
from workflows.config import LimitSettings, MethodSettings
from workflows.stages.sandbox import MAX_REPEATS, Sandbox, Worker

FAULTS = Path(__file__).parents[1] / "workflow" / "baselines"
LIMITS = LimitSettings(time_s=0.3, memory_mb=600, warm_up_s=30)


@pytest.fixture(autouse=True)
def _extra_baselines(monkeypatch):
    monkeypatch.setenv("DCREG_BASELINES_PATH", str(FAULTS))


def instance(n_points: int) -> Instance:
    points = np.random.default_rng(n_points).random((n_points, 2))
    return Instance("id", points, points, "similarity2d", 5, (0.5, 1.5), 0.1, 0)


def sandbox_with(fault: str, log: Path, time_s: float = LIMITS.time_s) -> Sandbox:
    method = MethodSettings(name="fault", baseline="fault", options={"fault": fault})
    return Sandbox(method, LIMITS.model_copy(update={"time_s": time_s}), log)


def three_runs(fault: str, log: Path, time_s: float = LIMITS.time_s) -> list[dict]:
    """Solve a good instance, the faulty one and a good one."""
    with sandbox_with(fault, log, time_s) as sandbox:
        return [sandbox.solve(instance(n)) for n in (10, 13, 11)]


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    """A sandbox of a method whose fault depends on the number of points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DCREG_BASELINES_PATH", str(FAULTS))
        with sandbox_with("any", tmp_path_factory.mktemp("sandbox") / "log") as sandbox:
            yield sandbox


@pytest.mark.parametrize(
    ("n_points", "status", "message"),
    [
        pytest.param(20, "converged", "", id="none"),
        pytest.param(21, "time_limit", "s; the limit is 0.3 s", id="is late"),
        pytest.param(22, "failed", "ZeroDivisionError: planted (adapter.py:", id="raises"),
        pytest.param(23, "failed", "the limit is 0.3 s", id="hangs"),
        pytest.param(24, "failed", "MB, twice", id="bursts"),
        pytest.param(25, "failed", "worker ended with exit code 3, twice", id="exits"),
        pytest.param(26, "failed", "worker died of SIGKILL, twice", id="is killed"),
        pytest.param(27, "failed", "worker died of SIGSEGV, twice", id="crashes"),
        pytest.param(28, "failed", "returned optimal without a pose", id="gives no pose"),
        pytest.param(29, "failed", "lower bound 5 above the upper bound 1", id="crosses bounds"),
        pytest.param(30, "failed", "returned time_limit without a pose", id="gives up"),
        pytest.param(31, "failed", "not finite", id="gives NaN"),
    ],
)
def test_a_fault_becomes_its_status_and_the_rest_completes(faulty, n_points, status, message):
    faulty_run, after = faulty.solve(instance(n_points)), faulty.solve(instance(11))
    assert faulty_run["status"] == status
    assert message in faulty_run["message"]
    assert after["status"] == "converged"
    assert (faulty_run.get("T_target_source") is None) == (status == "failed")


def test_a_run_that_ran_out_of_memory_states_what_it_used(faulty):
    run = faulty.solve(instance(24))
    assert run["message"].startswith("MemoryError: ")
    assert run["peak_memory_mb"] > 0.0
    assert run["time_solve_s"] < 1.0


def test_a_search_reports_what_it_has_proven_at_most_once_a_second(faulty, monkeypatch):
    heard = []
    faulty.prepare(instance(10))
    monkeypatch.setattr(faulty._worker, "watch", heard.append)
    assert faulty.solve(instance(32))["status"] == "converged"
    assert [proven for proven in heard if proven is not None] == [0.25]


@pytest.mark.parametrize(
    ("fault", "mark"),
    [
        ("crashes_once", "crashed"),
        ("stops_once", "stopped"),
        ("exhausts_once", "exhausted"),
        ("waits_once", "waited"),
    ],
)
def test_a_run_whose_worker_dies_is_suspended_or_gets_no_memory_is_tried_again(
    tmp_path, monkeypatch, fault, mark
):
    monkeypatch.setenv("DCREG_FAULT_TOKENS", str(tmp_path))
    runs = three_runs(fault, tmp_path / "log")
    assert [run["status"] for run in runs] == ["converged"] * 3
    assert (tmp_path / mark).exists()


def test_a_worker_that_takes_too_much_memory_is_lost(tmp_path):
    """The memory limit is hit before the time limit, also on a busy machine."""
    before, faulty_run, after = three_runs("grows", tmp_path / "log", time_s=20.0)
    assert before["status"] == after["status"] == "converged"
    assert faulty_run["status"] == "failed"
    assert "the limit is 600 MB" in faulty_run["message"]
    assert faulty_run.get("T_target_source") is None


def test_a_run_that_compiled_is_repeated_and_not_timed(tmp_path):
    before, faulty_run, after = three_runs("compiles", tmp_path / "log")
    assert [run["status"] for run in (before, faulty_run, after)] == ["converged"] * 3
    assert faulty_run["time_solve_s"] < faulty_run["time_warmup_s"]
    assert (
        faulty_run["time_warmup_s"] > before["time_warmup_s"] + 3.0
    )  # which contains the compilation
    assert after["time_warmup_s"] == faulty_run["time_warmup_s"]  # one worker all along
    assert (tmp_path / "log").read_text().count("repeated, as it compiled code") == 1


def test_a_method_that_always_compiles_is_timed_in_the_end(tmp_path):
    _, faulty_run, _ = three_runs("always_compiles", tmp_path / "log", time_s=20.0)
    assert faulty_run["status"] == "converged"
    assert (tmp_path / "log").read_text().count("repeated") == MAX_REPEATS


def test_a_hang_ends_soon_after_its_limit_with_all_its_children(tmp_path):
    three_runs("hangs_with_child", tmp_path / "log")
    (line,) = [x for x in (tmp_path / "log").read_text().splitlines() if x.startswith("child")]
    child = int(line.split()[1])
    deadline = time.monotonic() + 5
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(child)


def alive(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_unavailable_names_how_to_get_it_without_warm_up(tmp_path, monkeypatch):
    folder = tmp_path / "absent"
    folder.mkdir()
    card = (FAULTS / "fault" / "card.yaml").read_text()
    extra = "requires: no_such_module\nhow_to_get: ask nobody\n"
    (folder / "card.yaml").write_text(card + extra)
    (folder / "adapter.py").write_text((FAULTS / "fault" / "adapter.py").read_text())
    monkeypatch.setenv("DCREG_BASELINES_PATH", str(tmp_path))
    with Sandbox(MethodSettings(name="x", baseline="absent"), LIMITS, tmp_path / "log") as sandbox:
        answers = [sandbox.solve(instance(n)) for n in (10, 11)]
    assert [answer["status"] for answer in answers] == ["unavailable"] * 2
    assert "ask nobody" in answers[1]["message"]


def test_unsupported_is_a_status(tmp_path):
    method = MethodSettings(name="ransac", baseline="fpfh_ransac")  # 3D only
    limits = LimitSettings(time_s=5, warm_up_s=60)
    with Sandbox(method, limits, tmp_path / "log") as sandbox:
        answer = sandbox.solve(instance(10))
    assert answer["status"] in ("unsupported", "unavailable")  # where open3d cannot be imported


def test_a_worker_starts_with_capped_threads(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    worker = Worker(threads=1, memory_mb=600, log=tmp_path / "log")
    try:
        environ = {}
        until = time.monotonic() + 20.0
        while "OMP_NUM_THREADS" not in environ and time.monotonic() < until:  # not yet started
            environ = psutil.Process(worker.process.pid).environ()
    finally:
        worker.kill()
    assert environ["OMP_NUM_THREADS"] == environ["NUMBA_NUM_THREADS"] == "1"
    assert not alive(worker.process.pid)
