"""How the lines of figures and tables are called, and the commands that repeat them."""

import json
import os
import shlex

import pytest
from typer.testing import CliRunner

from workflows import config
from workflows.__main__ import app
from workflows.blocks import Needs
from workflows.config import MethodSettings, parse_selection
from workflows.labels import display_name, display_names, distinct
from workflows.stages.aggregate import run_command
from workflows.stages.plan import expand

CONFIG = """
name: mine
datasets: [{dataset: embedded, shapes: [fish], n_points: 10, tests: {noise: [0.01]}}]
methods: [{name: icp, baseline: icp}]
"""


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"baseline": "icp"}, "ICP (trimmed, multi-start)"),
        ({"baseline": "icp", "label": "ICP, mine"}, "ICP, mine"),
        ({"baseline": "icp", "n_inliers_ratio": 0.5}, "ICP (trimmed, multi-start, n_p × 0.5)"),
        ({"baseline": "rpm_pa"}, "RPM-PA (reconstructed)"),
        ({"baseline": "rpm_pa", "label": "RPM-PA exact"}, "RPM-PA exact (reconstructed)"),
        ({"baseline": "rpm_pa", "label": "Reconstructed PA"}, "Reconstructed PA"),
    ],
)
def test_no_label_hides_a_reconstruction(settings, expected):
    assert display_name(MethodSettings(name="line", **settings)) == expected


def test_methods_of_one_baseline_state_in_which_options_they_differ():
    names = display_names(
        [
            MethodSettings(name="dcreg", baseline="dcreg"),
            MethodSettings(name="cpd", baseline="cpd"),
            MethodSettings(name="cpd-multi", baseline="cpd", options={"starts": "multi"}),
            MethodSettings(name="cpd-small", baseline="cpd", n_points=50),
            MethodSettings(name="icp", baseline="icp"),
            MethodSettings(name="icp-too", baseline="icp"),
        ]
    )
    assert names == {
        "dcreg": "DC-Reg",
        "cpd": "CPD",
        "cpd-multi": "CPD (starts multi)",
        "cpd-small": "CPD (n points 50)",
        "icp": "ICP (trimmed, multi-start) [icp]",
        "icp-too": "ICP (trimmed, multi-start) [icp-too]",
    }
    assert distinct({"a": "A", "b": ""}) == {"a": "A", "b": "[b]"}


def test_the_commands_of_a_config_given_by_path_work(tmp_path):
    path = tmp_path / "a folder whose name is longer than a line of the table" / "mine.yaml"
    path.parent.mkdir()
    path.write_text(CONFIG)
    selection = parse_selection(["tests=noise", "levels=0.01"])
    plan = expand(config.load(str(path)), selection, config.origin(str(path)))
    run = next(plan.runs())
    done = CliRunner().invoke(app, ["replay", run.run_id, "--experiment", str(path)])
    assert done.exit_code == 0, done.output
    assert json.loads(done.output)["status"] == "converged"
    words = shlex.split(run_command(plan))
    done = CliRunner().invoke(app, [*words[3:], "--dry-run", "--directory", str(path.parent)])
    assert done.exit_code == 0, done.output
    assert "1 runs, 0 of them finished" in done.output
    report = path.parent / "results/mine/parts/tests-noise_levels-0.01/report/index.html"
    assert f"no report yet: {os.path.relpath(report)}\n" in done.output
    of_blocks = expand(config.load(str(path)), None, str(path), Needs({"noise": {"icp": 1}}))
    assert shlex.split(run_command(of_blocks))[3:] == ["evidence", "--experiments", str(path)]
