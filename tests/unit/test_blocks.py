"""Blocks of an experiment: which runs are needed, left out, and counted."""

from __future__ import annotations

import pytest

from workflows.blocks import Needs
from workflows.compose import ConfigError
from workflows.config import DatasetSettings, Experiment
from workflows.stages.plan import expand, plan_table

ENTRY = {
    "dataset": "embedded", "shapes": ["fish", "glyph"], "trials": 5, "n_points": 12,
    "tests": {"noise": [0.0, 0.02], "deformation": [0.01]},
}  # fmt: skip
METHODS = [{"name": name, "baseline": name} for name in ("dcreg", "icp")]
EXPERIMENT = Experiment.model_validate({"name": "blocks", "datasets": [ENTRY], "methods": METHODS})
NEEDS = Needs({"noise": {"dcreg": 3, "icp": 1}})


def test_a_block_of_all_levels_has_all_shapes_and_one_trial():
    plan = expand(EXPERIMENT, needs=NEEDS)
    assert [chunk.block for chunk in plan.chunks] == [("noise", 0.0, each) for each in range(3)]
    for chunk in plan.chunks:
        cells = {(each.shape, each.level) for each in chunk.instances}
        assert cells == {(s, level) for s in ("fish", "glyph") for level in (0.0, 0.02)}


def test_the_runs_of_a_long_block_are_split_into_several_jobs():
    plan = expand(EXPERIMENT, needs=Needs({"deformation": {"icp": 1}, "noise": {"icp": 1}}))
    assert [len(chunk.instances) for chunk in plan.chunks] == [4, 2]
    levels = [0.01 * each for each in range(6)]
    entry = {**ENTRY, "tests": {"noise": levels}}
    longer = EXPERIMENT.model_copy(update={"datasets": [DatasetSettings.model_validate(entry)]})
    sizes = [len(chunk.instances) for chunk in expand(longer, needs=NEEDS).chunks]
    assert sizes == [4, 4, 4] * 3


def test_runs_are_needed_or_left_out_and_none_is_both():
    plan = expand(EXPERIMENT, needs=NEEDS)
    needed, left_out = (plan_table(plan, runs) for runs in (plan.runs(), plan.left_out()))
    assert needed.groupby("method").size().to_dict() == {"dcreg": 12, "icp": 4}
    assert left_out.groupby("method").size().to_dict() == {"icp": 8}
    assert not set(needed["run_id"]) & set(left_out["run_id"])


def test_needed_runs_are_those_of_the_whole_experiment():
    """They have the same identity, so results are shared."""
    whole = {run.run_id for run in expand(EXPERIMENT).runs()}
    assert {run.run_id for run in expand(EXPERIMENT, needs=NEEDS).runs()} < whole


def test_a_method_that_skipped_blocks_starts_with_the_first():
    levels = [0.0, 0.02]
    more = NEEDS.with_block("noise", ["dcreg", "icp"], levels)
    more = more.with_block("deformation", ["dcreg"], [0.01])
    numbers = {each: more.of_all("noise", [each], levels) for each in ("dcreg", "icp")}
    assert numbers == {"dcreg": 3, "icp": 2}
    assert more.of_all("noise", ["dcreg", "icp"], levels) == 2
    assert more.of("dcreg", "deformation", 0.01) == 1
    again = more.with_block("noise", ["dcreg"], levels)
    assert again.of_all("noise", ["dcreg"], levels) == 4
    names = [chunk.name for chunk in expand(EXPERIMENT, needs=NEEDS).chunks]
    assert set(names) < {chunk.name for chunk in expand(EXPERIMENT, needs=more).chunks}


def test_a_block_has_the_levels_that_its_claim_compares():
    more = NEEDS.with_block("noise", ["icp"], [0.02])
    assert more.trials["noise"] == {"dcreg": 3, "icp": {"0.02": 2, "*": 1}}
    assert (more.of("icp", "noise", 0.02), more.of("icp", "noise", 0.0)) == (2, 1)
    plan = expand(EXPERIMENT, needs=more)
    added = {run.run_id for run in plan.runs()} - {
        run.run_id for run in expand(EXPERIMENT, needs=NEEDS).runs()
    }
    cells = [run for run in plan.runs() if run.run_id in added]
    assert {(r.method.name, r.instance.level, r.instance.trial) for r in cells} == {
        ("icp", 0.02, 1)
    }
    every = [*plan.runs(), *plan.left_out()]
    assert len({run.run_id for run in every}) == len(every) == 24
    for chunk in plan.chunks:
        users = {plan.needs.users(i.test, i.level, i.trial) for i in chunk.instances}
        assert len(users) == 1


def test_joined_needs_have_the_larger_number_at_each_level():
    one = Needs({"noise": {"icp": {"0.02": 4}, "cpd": 1}})
    other = Needs({"noise": {"icp": 3}, "deformation": {"icp": 1}})
    both = Needs({"noise": {"icp": {"0.02": 4, "*": 3}, "cpd": 1}, "deformation": {"icp": 1}})
    assert one.joined(other) == other.joined(one) == both
    assert both.joined(one) == both
    assert one.joined(Needs({"noise": {"icp": 4}})).trials["noise"]["icp"] == 4


def test_needs_survive_their_file(tmp_path):
    for needs in (NEEDS, NEEDS.with_block("noise", ["icp"], [0.02])):
        needs.write(tmp_path / "needs.json")
        assert Needs.read(tmp_path / "needs.json") == needs


@pytest.mark.parametrize(
    "content",
    ["{", "[1]", '{"noise": 3}', '{"noise": {"icp": -1}}', '{"noise": {"icp": {"0.1": -1}}}'],
)
def test_a_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "needs.json"
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"needs\.json: not a list of blocks"):
        Needs.read(path)
