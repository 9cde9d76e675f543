"""The estimate of the memory before a solve, and the refusal of what does not fit."""

import itertools
import logging
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dcreg
from dcreg.driver import first_stages as stages
from dcreg.driver import memory
from dcreg.driver.downsample import to_search
from dcreg.driver.modes import choose_mode, find_mode
from dcreg.families.rigid3d.cover import CongruentCover
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.problem import Problem
from tests.problems import register


def clouds(n, m, dim):
    rng = np.random.default_rng(0)
    return rng.standard_normal((n, dim)), rng.standard_normal((m, dim))


def estimate(n, m, model="rigid3d", candidates=None):
    problem = Problem(
        *clouds(n, m, 2 if model == "similarity2d" else 3), 0.8, model, None, candidates
    )
    (searched,) = to_search([problem], None, None, None)
    mode = find_mode(model, choose_mode(searched))
    return memory.estimated_memory(problem, searched, mode, None)


def test_the_estimate_is_near_the_measured_peak():
    """The peak is that of a separate process."""
    code = (
        "from tests.bench.measure import peak_memory_mb\n"
        "from tests.unit.test_memory import clouds, register\n"
        "x, y = clouds(100, 100, 3)\n"
        "found = register(x, y, n_inliers=0.8, model='rigid3d', time_limit=0.5)\n"
        "print(found.memory_estimate.peak_mb, peak_memory_mb())"
    )
    finished = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2]
    )
    estimated, measured = map(float, finished.stdout.split())
    assert 1 / 1.5 < estimated / measured < 1.5


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
def test_more_points_need_more_memory(model):
    peaks = [estimate(n, n, model).peak_mb for n in (10, 1500, 3000, 30_000)]
    # 1,500 points are matched densely; a sample of more is searched, and matched by neighbours
    assert peaks[0] < peaks[1]
    assert peaks[0] < peaks[2] < peaks[3]


def test_candidates_need_a_dense_matrix():
    half = np.indices((2500, 2500)).sum(axis=0) % 2 == 0
    assert estimate(2500, 2500, candidates=half).peak_mb > 100 + estimate(2500, 2500).peak_mb


def test_weights_and_further_numbers_of_pairs_need_more_memory():
    x, y = clouds(1000, 1000, 2)
    weights = dcreg.PointWeights(source=np.linspace(1.0, 2.0, 1000), distance=0.5)
    plain = Problem(x, y, 0.8, "similarity2d")
    weighted = Problem(x, y, 0.8, "similarity2d", weights=weights)
    mode = find_mode("similarity2d", "paper")
    peak = memory.estimated_memory(plain, plain, mode, None).peak_mb
    assert memory.estimated_memory(weighted, weighted, mode, None).peak_mb > peak + 16
    assert peak + 1 < memory.estimated_memory(plain, plain, mode, None, 9).peak_mb < peak + 10


def test_a_problem_that_does_not_fit_is_refused_before_the_search(monkeypatch):
    monkeypatch.setattr(memory, "available_mb", lambda: 20.0)
    x, y = clouds(1500, 1400, 2)
    message = (
        r"source, target: 1,500 and 1,400 points need about 2\d\d MB of memory, but 20 MB are available; "
        r"search a sample \(downsample=200"
    )
    with pytest.raises(dcreg.InputError, match=message):
        register(x, y, n_inliers=0.5, model="similarity2d", mode="paper")


def test_the_available_memory_is_that_of_the_machine():
    lines = Path("/proc/meminfo").read_text().splitlines()
    total = int(lines[0].split()[1]) / 1024
    assert 0.0 < memory.available_mb() < total


@pytest.mark.parametrize(
    ("n", "time_s", "notice"),
    [
        (100, 60.0, None),
        (100, None, "memory: 2.* MB more, and 352 bytes for each open box; time: no limit"),
        (100, 36e3, "time: at most about 36,000 s"),
        (2000, 60.0, r"memory: [\d]+ MB; .* time: at most about 60 s"),
    ],
)
def test_large_work_is_announced(n, time_s, notice):
    problem = Problem(*clouds(n, n, 3), 0.8, "rigid3d")
    assert memory.is_large_work(problem, time_s) == (notice is not None)
    said = memory.advance_notice(estimate(n, n), time_s, {"initial poses": 2.0, "all points": 0.01})
    assert re.search(notice or "memory", said), said
    assert " (initial poses about 2 s, all points about 0.1 s). The time until" in said


@pytest.mark.parametrize(
    ("sizes", "seconds"), [((400, 400), 1.92), ((1600, 1600), 7.2), ((100, 900), 0.6)]
)
def test_the_first_stages_take_the_measured_time(sizes, seconds, monkeypatch):
    monkeypatch.setattr(stages, "slowness", lambda: 2.0)
    problem, mode = Problem(*clouds(*sizes, 3), 0.8, "rigid3d"), find_mode("rigid3d", "full")
    found = stages.first_stages(problem, problem, mode)
    assert found == {"initial poses": pytest.approx(2.0 * seconds, rel=0.05)}
    many = Problem(*clouds(20_000, 20_000, 3), 0.8, "rigid3d")
    sampled = stages.first_stages(many, problem, mode)
    assert sampled == found | {"all points": pytest.approx(2.0 * 2.0)}
    flat = Problem(*clouds(300, 300, 2), 0.8, "similarity2d")
    paper = stages.first_stages(flat, flat, find_mode("similarity2d", "paper"))
    assert paper["initial poses"] == pytest.approx(2.0 * 1.1, rel=0.05)
    norms = stages.first_stages(problem, problem, find_mode("rigid3d", "paper"))
    assert norms == {}  # they use the rest of the time limit


def test_the_slowness_of_a_machine_is_that_of_its_clock(monkeypatch):
    moments = itertools.count(0.0, 4.2e-3)
    monkeypatch.setattr(stages.time, "perf_counter", lambda: next(moments))
    assert stages.slowness() == pytest.approx(2.0)


def test_the_notice_comes_before_the_search_and_the_estimate_is_in_the_result(caplog):
    with caplog.at_level(logging.INFO, "dcreg"):
        found = register(*clouds(8, 8, 2), n_inliers=8, model="similarity2d", time_limit=None)
    assert f"estimated memory: {found.memory_estimate}; time: no limit" in caplog.text
    assert found.to_dict()["memory_estimate"]["box_bytes"] == 104


def test_no_time_is_measured_for_a_notice_that_is_not_shown(caplog, monkeypatch):
    monkeypatch.setattr(stages, "slowness", lambda: pytest.fail("measured"))
    with caplog.at_level(logging.WARNING, "dcreg"):
        register(*clouds(8, 8, 2), n_inliers=8, model="similarity2d", time_limit=None)


def test_triples_are_not_used_with_so_many_targets_that_their_distances_do_not_fit():
    assert CongruentCover(Rigid3D(*clouds(40, 2000, 3), 30)).applies
    assert not CongruentCover(Rigid3D(*clouds(40, 2001, 3), 30)).applies
