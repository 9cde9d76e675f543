"""The types of the library serve a user who checks scripts with mypy --strict."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import dcreg

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tests" / "typing" / "user_script.py"


def strict(script: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    """Check a script with mypy --strict and no config; the library comes from the checkout."""
    options = ["--strict", "--config-file=", "--follow-imports=silent", "--cache-dir", str(cache)]
    return subprocess.run(
        [sys.executable, "-m", "mypy", *options, str(script)],
        cwd=cache, capture_output=True, text=True, env={**os.environ, "MYPYPATH": str(ROOT)},
    )  # fmt: skip


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("mypy")


def test_a_users_script_passes_strict_checks(cache: Path) -> None:
    checked = strict(SCRIPT, cache)
    assert checked.returncode == 0, checked.stdout


def test_every_public_name_is_exported_and_a_wrong_use_is_found(cache: Path) -> None:
    names = [name for name in dcreg.__all__ if name != "__version__"]
    script = cache / "script.py"
    wrong = "value: str = dcreg.register([[0.0]], [[0.0]])"
    script.write_text("import dcreg\n" + "".join(f"dcreg.{name}\n" for name in names) + wrong)
    checked = strict(script, cache)
    lines = [line for line in checked.stdout.splitlines() if ": error: " in line]
    assert lines
    assert all(f"script.py:{len(names) + 2}: " in line for line in lines), checked.stdout
    assert any("[assignment]" in line for line in lines)


def test_the_package_says_that_it_has_types() -> None:
    assert (ROOT / "dcreg" / "py.typed").is_file()
