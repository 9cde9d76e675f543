"""The boxes of a search are recorded without changing it, and drawn as slices."""

from importlib import import_module

import numpy as np
import pytest

from dcreg import register
from dcreg.search import Box, Boxes, Confined, Recorder, recording
from reports import boxes


@pytest.fixture(scope="module")
def recorded():
    rng = np.random.default_rng(2)
    source = rng.random((8, 2))
    target = 1.1 * source[:, ::-1] + 0.05 * rng.random((8, 2))
    solve = {"n_inliers": 7, "model": "similarity2d"}
    expected = register(source, target, **solve)
    with recording() as recorder:
        found = register(source, target, **solve)
    assert recorder.is_complete
    assert (found.n_nodes, found.lower_bound) == (expected.n_nodes, expected.lower_bound)
    return found, recorder


def test_every_bounded_box_is_recorded(recorded):
    found, recorder = recorded
    (stage,) = recorder.stages.values()
    assert recorder.n_boxes == found.n_nodes
    assert stage.ends[-1][0] <= stage.ends[-1][1]
    assert [end[1] for end in stage.ends] == sorted((end[1] for end in stage.ends), reverse=True)


def test_the_leaf_boxes_of_a_slice_cover_it(recorded):
    _, recorder = recorded
    ((name, stage),) = recorder.stages.items()
    shown = boxes.stage_of(name, stage, "similarity2d")
    assert len(shown["slices"]) == 6
    first = shown["slices"][0]
    assert first["axes"] == ["s cos α", "s sin α"]
    left, right, low, high = (np.array(side) for side in first["boxes"])
    root = (right - left) * (high - low)
    pruned = ~np.array(first["open"], bool)  # a finished search has pruned or divided every box
    assert root[pruned].sum() == pytest.approx(root[0])
    assert (np.diff(first["order"]) > 0).all()
    at = first["at"]
    inside = (left <= at[0]) & (at[0] <= right) & (low <= at[1]) & (at[1] <= high)
    assert inside[pruned].any()


def test_the_page_of_boxes_states_the_units_of_its_bounds(recorded):
    found, recorder = recorded
    result = {
        "method": "DC-Reg (ours)", "test": "fish noise 0.1", "trial": 0, "status": found.status,
        "stored": "same", "lower_bound": found.lower_bound, "upper_bound": found.objective,
    }  # fmt: skip
    page = boxes._render("1f", result, recorder, "similarity2d")
    assert f"in squared target units: lower {found.lower_bound:.4g}, upper" in page
    assert "normalised lower bound" in page  # of the search
    assert "Bounds of the run" not in boxes._render(
        "1f", {**result, "lower_bound": None}, recorder, ""
    )


def test_nothing_is_recorded_outside_the_context(recorded):
    _, recorder = recorded
    count = recorder.n_boxes
    points = np.random.default_rng(4).random((6, 2))
    register(points, points, n_inliers=6, model="similarity2d")
    assert recorder.n_boxes == count


def test_a_recording_ends_at_the_first_round_that_does_not_fit(monkeypatch):
    """A smaller round after it would leave a gap, and a later stage would have no boxes to draw."""
    monkeypatch.setattr(import_module("dcreg.search.recording"), "MOST_BOXES", 10)
    recorder, end = Recorder(), (0.0, 1.0, np.zeros(2))
    for size in (8, 4, 1):
        rounds = Boxes.of([Box(np.zeros(2), np.ones(2))] * size)
        recorder.add("first", rounds, np.ones(size, bool), end)
    recorder.confine("second", Confined(rounds, np.inf))
    assert (recorder.n_boxes, recorder.is_complete, list(recorder.stages)) == (8, False, ["first"])
