"""A slice of `make questions` in every test run."""

from dataclasses import replace
from functools import cache

import pytest

import dcreg
from tests.questions.checks import CHECKS

COUNTS = {
    "max_rms": 8, "certify": 6, "alternatives": 5, "max_inliers": 6, "range": 5, "sweep": 4,
    "similarity3d": 4, "weights": 5, "candidates": 5, "attributes": 4, "init": 4, "covariance": 4,
}  # fmt: skip
OPEN = ("open", "at least", "interval", "time_limit", "converged")


@cache
def answers(question):
    """The answers of a question, and what is wrong with them."""
    return [CHECKS[question](number) for number in range(COUNTS[question])]


@pytest.mark.parametrize("question", CHECKS)
def test_no_answer_about_small_problems_is_wrong(question):
    assert not [faults for _, faults in answers(question) if faults]


@pytest.mark.parametrize("question", CHECKS)
def test_many_questions_are_answered(question):
    """In three dimensions two or three pairs can leave a rotation open: then there is no answer."""
    answered = [answer for answer, _ in answers(question) if answer not in OPEN]
    assert len(answered) >= COUNTS[question] // 4


def test_a_bound_raised_above_the_fit_of_another_matching_is_wrong(monkeypatch):
    ask = dcreg.alternatives
    monkeypatch.setattr(
        dcreg,
        "alternatives",
        lambda *clouds, **given: replace(ask(*clouds, **given), lower_bound=1e6),
    )
    _, faults = CHECKS["alternatives"](0)
    assert [fault for fault in faults if fault.endswith("away)")]
