"""The recorded state of the checkout."""

import subprocess

from workflows import provenance


def test_an_uncommitted_method_is_a_difference_but_results_are_none(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "CHECKOUT", tmp_path)
    author = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for arguments in (["init", "-q"], [*author, "commit", "-q", "--allow-empty", "-m", "First"]):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "runs.csv").touch()
    state = provenance.git_state()
    assert (len(state["commit"]), state["dirty"], state["untracked"]) == (40, False, [])
    (tmp_path / "baselines" / "mine").mkdir(parents=True)
    (tmp_path / "baselines" / "mine" / "solve.py").touch()
    state = provenance.git_state()
    assert (state["dirty"], state["untracked"]) == (True, ["baselines/mine/solve.py"])
