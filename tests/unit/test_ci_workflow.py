"""The workflow of GitHub Actions: existing commands, scripts that parse, official actions, few rights."""

import re
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
CONTENT = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
JOBS = CONTENT["jobs"]
STEPS = [step for job in JOBS.values() for step in job["steps"]]
SCRIPTS = [step["run"] for step in STEPS if "run" in step]
KEYS = {"name", "if", "uses", "with", "run"}


def test_it_runs_for_pull_requests_with_rights_to_read_only():
    assert set(CONTENT[True]) == {"pull_request", "push"}  # YAML reads the key `on` as true
    assert CONTENT["permissions"] == {"contents": "read"}
    assert all(job["timeout-minutes"] <= 60 and job["runs-on"] for job in JOBS.values())


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.get("name") or str(step)[:40])
def test_a_step_uses_an_official_action_or_runs_a_script(step):
    assert set(step) <= KEYS
    assert ("uses" in step) != ("run" in step)
    assert re.fullmatch(r"actions/[a-z-]+@v\d+", step.get("uses", "actions/checkout@v1"))


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_parses_and_calls_existing_targets(script):
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^## ([a-z0-9-]+):", makefile, re.MULTILINE)) | {"dev"}
    assert set(re.findall(r"\bmake ([a-z-]+)", script)) <= targets
    for variable in re.findall(r" ([A-Z]+)=", script):
        assert f"$({variable})" in makefile


def test_it_runs_tests_benchmark_and_comparison():
    called = " ".join(SCRIPTS)
    for command in (
        "make test",
        "make bench QUICK=1",
        "make compare BASE=",
        "$GITHUB_STEP_SUMMARY",
    ):
        assert command in called


def test_the_files_to_keep_are_in_the_checkout():
    """The action rejects every path with `..`; it and a failed comparison would look alike."""
    (kept,) = [step["with"]["path"] for step in STEPS if "upload-artifact" in step.get("uses", "")]
    assert all(path.startswith("results/") and ".." not in path for path in kept.split())
    assert "git worktree add --detach results/base origin/main" in SCRIPTS


def test_the_base_runs_the_config_of_the_pull_request_under_its_own_name():
    """A config in another place with the name of a present one is refused."""
    (script,) = [script for script in SCRIPTS if "workflows run" in script]
    assert "cp workflows/configs/regression.yaml results/base/workflows/configs/\n" in script
    assert re.findall(r"workflows run (\S+)", script) == ["regression"] * 2
