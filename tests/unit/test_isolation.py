"""A method can read neither the ground truth nor secrets of the environment."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from baselines.contract import Instance
from workflows import CHECKOUT
from workflows.config import LimitSettings, MethodSettings
from workflows.stages import isolation
from workflows.stages.sandbox import Sandbox

CHEAT = Path(__file__).parents[1] / "workflow" / "baselines"


@pytest.fixture
def attempts(tmp_path, monkeypatch):
    """Run the cheating method next to a file of ground truth; return which attempts succeeded."""
    truth = tmp_path / "results" / "demo" / "truth" / "2d-00.npz"
    truth.parent.mkdir(parents=True)
    np.savez(truth, T_true=np.eye(3))
    truth.chmod(0o600)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DCREG_BASELINES_PATH", str(CHEAT))
    monkeypatch.setenv("A_PASSWORD", "1234")
    monkeypatch.setenv("DCREG_DATA_MIRROR", "https://user:1234@localhost")

    def run() -> dict[str, float]:
        points = np.random.default_rng(0).random((9, 2))
        instance = Instance("id", points, points, "similarity2d", 5, (0.5, 1.5), 0.1, 0)
        method = MethodSettings(name="cheat", baseline="cheat")
        with Sandbox(method, LimitSettings(time_s=20), tmp_path / "log") as sandbox:
            answer = sandbox.solve(instance)
        assert answer["status"] == "converged", answer
        return answer["extra"]

    return run


def test_no_attempt_of_a_cheating_method_succeeds(attempts):
    if isolation.ruleset([]) is None:
        pytest.skip("this system has no Landlock")
    found = attempts()
    assert len(found) == 11
    assert not [attempt for attempt, succeeded in found.items() if succeeded]


def test_every_attempt_succeeds_without_the_isolation(attempts, monkeypatch):
    """Otherwise the test above would show nothing."""
    monkeypatch.setattr(
        isolation, "environment", lambda given, *_: {**given, "PYTHONPATH": str(CHECKOUT)}
    )
    monkeypatch.setattr(isolation, "ruleset", lambda hidden: None)
    assert all(attempts().values())


def test_without_landlock_the_environment_is_protected_and_the_log_warns(
    attempts, tmp_path, monkeypatch
):
    monkeypatch.setattr(isolation, "ruleset", lambda hidden: None)
    assert not attempts()["has_a_secret"]
    assert "can read the ground truth" in (tmp_path / "log").read_text()


def test_variables_for_threads_locale_and_methods_are_passed():
    given = {
        "PATH": "/bin", "LC_ALL": "C", "OPENBLAS_CORETYPE": "Haswell", "OMP_NUM_THREADS": "7",
        "DCREG_DCP_WEIGHTS": "w.pt", "PYTHONPATH": "/more", "AWS_SECRET_ACCESS_KEY": "1234",
        "DCREG_DATA_MIRROR": "https://user:1234@localhost", "TMPDIR": "/other",
    }  # fmt: skip
    found = isolation.environment(given, 2, Path("/mine"))
    kept = {"PATH", "LC_ALL", "OPENBLAS_CORETYPE", "DCREG_DCP_WEIGHTS"}
    assert {name: found[name] for name in kept} == {name: given[name] for name in kept}
    assert found["OMP_NUM_THREADS"] == "2"
    assert found["TMPDIR"] == "/mine"
    assert found["PYTHONPATH"].endswith(f"{os.pathsep}/more")
    assert not {"AWS_SECRET_ACCESS_KEY", "DCREG_DATA_MIRROR"} & set(found)


def test_links_do_not_uncover_what_is_hidden(tmp_path):
    hidden = tmp_path / "place" / "results"
    (hidden / "truth").mkdir(parents=True)
    (tmp_path / "open").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "place")
    allowed = set(isolation.allowed({hidden, hidden / "truth"}))
    assert tmp_path / "open" in allowed
    assert not {tmp_path / "link", tmp_path / "place", tmp_path, Path("/")} & allowed
    assert not [path for path in allowed if path.is_relative_to(hidden)]


def test_copies_of_public_data_are_hidden(tmp_path, monkeypatch):
    """Recorded datasets contain their poses."""
    monkeypatch.setenv("DCREG_DATA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("DCREG_DATA_MIRROR", str(tmp_path / "mirror"))
    assert {tmp_path / "cache", tmp_path / "mirror"} <= set(isolation.hidden_folders())
    monkeypatch.setenv("DCREG_DATA_MIRROR", "https://example.org/data")
    assert not [path for path in isolation.hidden_folders() if "example.org" in str(path)]
