"""A short part of ``python -m tests.fuzz_parsers``, and proof that it finds faults."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace

import pytest

from tests.fuzz_parsers import __main__ as fuzzing
from tests.fuzz_parsers.parsers import PARSERS

POINTS = next(parser for parser in PARSERS if parser.name == "points")


@pytest.mark.slow
@pytest.mark.parametrize("parser", PARSERS, ids=lambda parser: parser.name)
def test_changed_files_are_read_or_refused(parser):
    found = {number: fuzzing.fault_of(parser, number) for number in range(parser.few)}
    assert not {number: details for number, (_, details) in found.items() if details}
    kinds = {kind for kind, _ in found.values()}
    assert len(kinds) > 1, f"all were treated alike: {kinds}"
    assert "read" in kinds or parser.few < 100


def test_another_error_and_an_empty_message_are_faults():
    def fails(path):
        raise KeyError(path)

    def is_silent(path):
        raise ValueError

    wrong = replace(POINTS, read=fails)
    assert fuzzing.fault_of(wrong, 0)[0] == "fault: KeyError"
    silent = replace(POINTS, read=is_silent, refusals=(ValueError,))
    assert fuzzing.fault_of(silent, 0) == ("ValueError", "the message is empty")


def test_crashes_and_hangs_are_counted_and_the_rest_is_tried(monkeypatch):
    monkeypatch.setattr(fuzzing, "HANG_S", 0.5)

    def reads(path):
        match campaign.number.value:
            case 3:
                os.kill(os.getpid(), signal.SIGSEGV)
            case 5:
                time.sleep(600)

    campaign = fuzzing.Campaign(replace(POINTS, read=reads), first=0)
    campaign.run(5.0)
    assert campaign.outcomes.pop("read") > 5
    assert dict(campaign.outcomes) == {"fault: exit code -11": 1, "fault: hangs": 1}
    assert {number for number, _ in campaign.faults.values()} == {3, 5}
