"""Blocks of an experiment: which runs are needed, left out, and counted."""

from __future__ import annotations

import pytest

from workflows.blocks import Needs
from workflows.compose import ConfigError
from workflows.config import Experiment
from workflows.stages.plan import expand, plan_table

ENTRY = {
    "dataset": "embedded", "shapes": ["fish", "glyph"], "trials": 5, "n_points": 12,
    "tests": {"noise": [0.0, 0.02], "deformation": [0.01]},
}  # fmt: skip
METHODS = [{"name": name, "baseline": name} for name in ("dcreg", "icp")]
EXPERIMENT = Experiment.model_validate({"name": "blocks", "datasets": [ENTRY], "methods": METHODS})
NEEDS = Needs({"noise": {"dcreg": 3, "icp": 1}})


def test_a_block_has_all_levels_and_shapes_of_a_test_and_one_trial():
    plan = expand(EXPERIMENT, needs=NEEDS)
    assert [chunk.block for chunk in plan.chunks] == [("noise", 0), ("noise", 1), ("noise", 2)]
    for chunk in plan.chunks:
        cells = {(each.shape, each.level) for each in chunk.instances}
        assert cells == {(s, level) for s in ("fish", "glyph") for level in (0.0, 0.02)}


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
    more = NEEDS.with_block("noise", ["dcreg", "icp"]).with_block("deformation", ["dcreg"])
    assert more.trials == {"noise": {"dcreg": 3, "icp": 2}, "deformation": {"dcreg": 1}}
    assert more.of_all("noise", ["dcreg", "icp"]) == 2
    assert more.with_block("noise", ["dcreg"]).trials["noise"] == {"dcreg": 4, "icp": 2}
    names = [chunk.name for chunk in expand(EXPERIMENT, needs=NEEDS).chunks]
    assert set(names) < {chunk.name for chunk in expand(EXPERIMENT, needs=more).chunks}


def test_needs_survive_their_file(tmp_path):
    NEEDS.write(tmp_path / "needs.json")
    assert Needs.read(tmp_path / "needs.json") == NEEDS


@pytest.mark.parametrize("content", ["{", "[1]", '{"noise": 3}', '{"noise": {"icp": -1}}'])
def test_a_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "needs.json"
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"needs\.json: not a list of blocks"):
        Needs.read(path)
