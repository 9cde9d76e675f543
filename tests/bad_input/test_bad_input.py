"""Every kind of bad input is refused with field, value and remedy: no traceback, no hang."""

import subprocess
import sys

import pytest

from tests.bad_input import AREAS


def test_there_are_many_kinds():
    assert sum(map(len, AREAS.values())) >= 335


@pytest.mark.slow
def test_bad_input_is_refused():
    """In a process of its own, since every case is forked from it."""
    command = [sys.executable, "-m", "tests.bad_input"]
    outcome = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
