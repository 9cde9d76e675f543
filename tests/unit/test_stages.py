"""Every stage of every 3D mode reports its bounds: to the listener, in the trace and on the page."""

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.plot.packing import unpack
from dcreg.search import Interrupted
from tests.problems import register


@pytest.fixture(scope="module")
def clouds():
    """15 points, 3 of them outliers."""
    rng = np.random.default_rng(5)
    source = rng.random((15, 3))
    target = source @ Rotation.random(random_state=3).as_matrix().T + [1.0, 2.0, 3.0]
    target += 0.02 * rng.standard_normal(target.shape)
    target[:3] = rng.random((3, 3)) + target.mean(axis=0) - 0.5
    return source, rng.permutation(target)


@pytest.fixture(scope="module", params=["full", "paper"])
def solved(request, clouds):
    heard = []
    settings = {"model": "rigid3d", "time_limit": 5.0, "mode": request.param}
    result = register(*clouds, n_inliers=12, **settings, listener=heard.append)
    return request.param, result, heard


def test_trace_holds_what_the_listener_heard(solved):
    _, result, heard = solved
    assert list(result.trace) == [event for event in heard if event.kind != "heartbeat"]


def test_every_stage_with_bounds_ends_with_them(solved):
    _, result, _ = solved
    ends = {event.stage: event for event in result.trace if event.kind == "end"}
    bounding = [stage for stage in result.stages if stage.status is not None]
    assert bounding
    for stage in bounding:
        event = ends[stage.name]
        assert (event.lower_bound, event.upper_bound) == (stage.lower_bound, stage.upper_bound)
        assert event.status == stage.status


def test_start_comes_first_with_a_pose(solved):
    _, result, _ = solved
    events = list(result.trace)
    assert events[0].stage == "start"
    assert np.isfinite(events[0].upper_bound)
    times = [event.time_s for event in events]
    assert times == sorted(times)


def test_events_of_the_start_do_not_refer_to_the_stage_before(solved):
    """The bounds of a start refer to its own poses."""
    _, result, _ = solved
    for event in result.trace:
        if event.stage == "start":
            assert (event.n_nodes, event.lower_bound) == (0, 0.0)


def test_the_last_event_has_the_upper_bound_even_if_no_local_search_ended(clouds, monkeypatch):
    def interrupted(*_):
        raise Interrupted

    settings = {"n_inliers": 4, "model": "rigid3d", "mode": "full"}
    register(*clouds, **settings)  # the kernels are compiled
    monkeypatch.setattr(Rigid3D, "refine", interrupted)
    monkeypatch.setattr(RigidBound, "_evaluate", interrupted)
    events = []
    result = register(*clouds, **settings, listener=events.append)
    assert result.status is dcreg.Status.TIME_LIMIT
    assert events[-1].kind == "end"
    assert events[-1].upper_bound == pytest.approx(result.upper_bound)
    assert result.trace.events[-1].upper_bound == result.upper_bound


def test_trace_file_and_page_name_all_stages(clouds, solved, tmp_path):
    mode, result, _ = solved
    trace, page = tmp_path / "o.jsonl", tmp_path / "o.html"
    result.trace.write_jsonl(trace)
    dcreg.plot_registration(*clouds, result, page)
    stages = {json.loads(line)["stage"] for line in trace.read_text().splitlines()}
    expected = {"full": {"rigid"}, "paper": {"search", "rotation"}}
    assert {"start"} | expected[mode] <= stages
    html = page.read_text(encoding="utf-8")
    figures = unpack(re.search(r'id="data">([^\n]*)</script>', html)[1]).decode()
    for stage in stages:
        assert f'"name":"{stage}"' in figures  # a band
