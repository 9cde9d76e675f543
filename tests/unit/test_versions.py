"""Declared versions: results are used again while the code is known to give the same ones."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from baselines import registry, template
from workflows import versions
from workflows.outcomes import TIMED

ADAPTER = """
import numpy as np
from baselines.contract import Baseline, Solution
from dcreg.status import Status

class Adapter(Baseline):
    def solve(self, instance, limits):
        pose = np.eye(instance.dim + 1)
        pose[:-1, -1] = SHIFT
        return Solution(Status.CONVERGED, pose)
"""


@pytest.fixture
def method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a method that only shifts."""
    folder = template.new_baseline("mine", root=tmp_path)
    edit_card(folder, parameters={}, ranges={})
    write_adapter(folder, "0.5")
    monkeypatch.setenv("DCREG_BASELINES_PATH", str(tmp_path))
    return folder


def edit_card(folder: Path, **facts: object) -> None:
    path = folder / "card.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **facts}))


def write_adapter(folder: Path, shift: str) -> None:
    """Write the adapter; texts differ in length, because Python compares sizes and whole seconds."""
    (folder / "adapter.py").write_text(ADAPTER.replace("SHIFT", shift))


def state(*reviewed: str, accept: bool = True) -> str:
    return next(iter(versions.check(["mine"], reviewed, accept=accept))).state


def test_code_with_the_same_results_keeps_its_version(method: Path) -> None:
    assert registry.fingerprint("mine") == registry.code_hash("mine")
    assert state() == versions.NEW
    assert registry.fingerprint("mine") == "mine 1"
    assert state() == versions.KNOWN
    write_adapter(method, "1.0 - 0.5")
    assert registry.fingerprint("mine") == registry.code_hash("mine")  # until it is checked
    assert state(accept=False) == versions.SAME
    assert registry.fingerprint("mine") == registry.code_hash("mine")
    assert state() == versions.SAME
    assert registry.fingerprint("mine") == "mine 1"


def test_other_results_need_another_version(method: Path) -> None:
    state()
    write_adapter(method, "0.625")
    assert state() == versions.CHANGED
    assert state("mine") == versions.CHANGED  # it can be compared
    write_adapter(method, "0.7125")
    edit_card(method, version=2)
    assert state() == versions.NEW
    assert registry.fingerprint("mine") == "mine 2"
    edit_card(method, version=1)
    assert state() == versions.LOWERED
    assert registry.fingerprint("mine") == registry.code_hash("mine")


@pytest.mark.parametrize(
    "facts", [{"deterministic": False}, {"requires": "no_such_module", "how_to_get": "nowhere"}]
)
def test_what_cannot_be_checked_is_not_stored_unless_it_was_reviewed(
    method: Path, facts: dict[str, object]
) -> None:
    edit_card(method, **facts)
    assert state() == versions.NEW
    write_adapter(method, "0.625")
    assert state() == versions.UNKNOWN
    assert state("mine") == versions.REVIEWED
    assert registry.fingerprint("mine").startswith("mine 1")
    assert (method.parent / "versions.json").is_file()
    with pytest.raises(registry.BaselineError, match="did you mean 'icp'"):
        state("icpp")


@pytest.mark.parametrize("name", registry.names(registry.ROOT))
def test_the_code_of_every_method_is_known(name: str) -> None:
    """If this fails: ``python -m workflows versions --accept``."""
    known = registry.known_codes()[name]
    assert known["version"] == registry.read_card(name).version
    assert registry.code_hash(name) in known["codes"]


@pytest.mark.parametrize("name", ["dcreg", "icp", "rpm_cav"])
def test_the_stored_results_are_those_of_the_code(name: str) -> None:
    found, stored = versions.results_of(name), registry.known_codes()[name]["results"]
    assert found == stored
    assert not any(each["status"] in TIMED for each in found)
