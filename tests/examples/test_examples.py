"""Every script of `examples/` runs, and its own assertions hold."""

import runpy
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))
SECONDS = 5.0  # of a script; kernels are compiled before


@pytest.fixture(scope="module", autouse=True)
def compiled():
    import dcreg

    dcreg.warm_up()


def test_there_are_examples():
    assert len(SCRIPTS) >= 7


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_example_runs(script, capsys):
    began = time.process_time()
    runpy.run_path(str(script), run_name="__main__")
    assert time.process_time() - began < SECONDS
    assert capsys.readouterr().out.strip(), "an example shows something"
    assert "assert " in script.read_text(encoding="utf-8"), "an example checks itself"
