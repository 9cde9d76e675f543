"""Pilots: when they run, what they run, and that the next call finishes them."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest

from reports.campaign import campaign as campaigning
from reports.campaign import run
from reports.campaign.campaign import Campaign
from reports.campaign.choice import Option
from reports.campaign.forecast import Forecast, Times
from reports.campaign.pilot import begun, pilots, unmeasured
from workflows.archives import runs_of
from workflows.blocks import Needs
from workflows.config import ConfigError, load
from workflows.stages.plan import expand

NAME = "paper2d-40"
EXPERIMENT = load(NAME)
NONE = Needs({})
PAIR = ("rpm_pa", "deformation")


def times(*tests: str) -> Times:
    """The times of a method on one level of these tests."""
    runs = pd.DataFrame({"test": tests}).assign(
        method=PAIR[0], level=0.01, time_solve_s=500.0, time_overhead_s=0.0
    )
    return Times.of([runs], EXPERIMENT)


@pytest.fixture
def costly():
    """The option of a claim about a method whose runs in one of two tests are measured."""
    needs = Needs({"noise": {"rpm_pa": 1}, "deformation": {"rpm_pa": 1}})
    step = Forecast(24, 5000.0, 12, {PAIR: 2400.0})
    return Option("claim", None, needs, step, step, 1, step.seconds)


def test_a_pilot_runs_two_levels_of_unmeasured_tests(costly):
    block = expand(EXPERIMENT, None, NAME, costly.needs)
    step = times("noise").of_runs(block.runs())
    assert list(step.unmeasured) == unmeasured(step) == [PAIR]
    (part,) = pilots([PAIR], EXPERIMENT, costly.needs)
    plan = expand(EXPERIMENT, part)
    (levels,) = {tuple(entry.tests["deformation"]) for entry in EXPERIMENT.datasets}
    assert part.levels == [levels[len(levels) // 4], levels[3 * len(levels) // 4]]
    assert {run.run_id for run in plan.runs()} < {run.run_id for run in block.runs()}


def test_a_pilot_runs_levels_of_its_block_only():
    needs = NONE.with_block("deformation", ["rpm_pa"], [0.04])
    (part,) = pilots([PAIR], EXPERIMENT, needs)
    assert part.levels == [0.04]


def test_unmeasured_runs_that_are_expected_to_be_short_have_a_pilot_too(costly):
    """The only known times of the method, in another test, may be far shorter."""
    known = times("noise")
    known.cells["mean"] = 1e-3
    step = known.of_runs(expand(EXPERIMENT, None, NAME, costly.needs).runs())
    assert step.seconds < 60.0
    assert unmeasured(step) == [PAIR]


def test_measured_and_short_unmeasured_steps_have_no_pilot(costly):
    """Levels between measured ones need none."""
    plan = expand(EXPERIMENT, None, NAME, costly.needs)
    step = times("noise", "deformation").of_runs(plan.runs())
    assert step.unseen > 0
    assert not unmeasured(step)
    assert not unmeasured(replace(costly.step, unmeasured={PAIR: 60.0}))


def test_a_pilot_precedes_its_block_once(costly, tmp_path, monkeypatch):
    """Also if it measures nothing: its method fails."""
    begun = []

    def ended(campaign, claim, expected, part=None, **_):
        begun.append((claim, part and part.tests))
        return len(begun) < 2

    monkeypatch.setenv("DCREG_ARCHIVES", "")
    monkeypatch.setattr(run, "_run", ended)
    monkeypatch.setattr(run, "_ahead", lambda *_: [(NAME, costly)])
    run.collect(1.0, [NAME], tmp_path, 1, tmp_path / "out")
    assert begun == [("claim", ["deformation"]), ("claim", None)]
    assert Needs.read(Campaign(NAME, tmp_path).needs_path) == costly.needs


def test_each_experiment_has_its_own_pilot(costly, tmp_path, monkeypatch):
    """Methods and tests may have the same names."""
    name = f"{NAME}-second"
    settings = EXPERIMENT.model_copy(update={"name": name})
    monkeypatch.setattr(
        campaigning, "load", lambda chosen: settings if chosen == name else EXPERIMENT
    )
    begun, turns = [], iter([NAME, name, name])

    def ended(campaign, claim, expected, part=None, **_):
        begun.append((campaign.name, part is not None))
        return len(begun) < 3

    monkeypatch.setenv("DCREG_ARCHIVES", "")
    monkeypatch.setattr(run, "_run", ended)
    monkeypatch.setattr(run, "_finish_blocks", lambda *_: True)
    monkeypatch.setattr(run, "_ahead", lambda *_: [(next(turns, NAME), costly)])
    run.collect(1.0, [NAME, name], tmp_path, 1, tmp_path / "out")
    assert begun == [(NAME, True), (name, True), (name, False)]


def test_the_next_call_finishes_an_interrupted_pilot(costly, tmp_path, monkeypatch):
    """Some of its runs have ended, so that its method and test are measured."""
    begun = []

    def interrupted(campaign, claim, expected, part=None, **_):
        begun.append((claim, expected.runs, part))
        return False

    monkeypatch.setenv("DCREG_ARCHIVES", "")
    monkeypatch.setattr(run, "_run", interrupted)
    monkeypatch.setattr(run, "_ahead", lambda *_: [(NAME, costly)])
    run.collect(1.0, [NAME], tmp_path, 1, tmp_path / "out")
    (part,) = pilots([PAIR], EXPERIMENT, costly.needs)
    planned = [each.run_id for each in expand(EXPERIMENT, part).runs()]
    monkeypatch.setattr(Campaign, "done", lambda self: set(planned[:1]))
    run.collect(1.0, [NAME], tmp_path, 1, tmp_path / "out")
    assert begun == [("claim", len(planned), part), ("resumed", len(planned) - 1, part)]
    monkeypatch.setattr(Campaign, "done", lambda self: set(planned))
    monkeypatch.setattr(run, "_ahead", lambda *_: [])
    run.collect(1.0, [NAME], tmp_path, 1, tmp_path / "out")
    assert len(begun) == 2
    assert not Campaign(NAME, tmp_path).pilots_path.exists()


@pytest.mark.parametrize("content", ["{", "1", "[1]", '[{"tests": 3}]'])
def test_a_damaged_file_of_pilots_is_refused(tmp_path, content):
    path = tmp_path / "pilots.json"
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"pilots\.json: not a list of pilots"):
        begun(path)


@pytest.mark.parametrize("name", ["paper2d-40", "paper3d-40"])
def test_pilots_would_have_forecast_the_archived_parts(name):
    """Within a factor of 1.5 each that took more than ten minutes."""
    experiment, runs = load(name), runs_of(name).dropna(subset="time_solve_s")
    found = {}
    for pair, part in runs.groupby(["method", "test"]):
        needs = Needs({pair[1]: {pair[0]: 1}})
        (pilot,) = pilots([pair], experiment, needs)
        known = Times.of(
            [part[part["level"].isin(pilot.levels) & (part["trial"] == 0)]], experiment
        )
        expected = sum(known.of_cell(*pair, level)[0] for level in part["level"])
        if (actual := part["time_solve_s"].sum()) > 600.0:
            found[pair] = expected / actual
    assert found
    assert {pair: ratio for pair, ratio in found.items() if not 1 / 1.5 < ratio < 1.5} == {}
