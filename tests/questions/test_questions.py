"""A slice of `make questions` in every test run."""

import pytest

from tests.questions.checks import CHECKS

COUNTS = {"max_rms": 60, "certify": 60, "alternatives": 24, "max_inliers": 40, "range": 60}


@pytest.mark.parametrize("question", CHECKS)
def test_no_answer_about_small_problems_is_wrong(question):
    checked = {number: CHECKS[question](number) for number in range(COUNTS[question])}
    assert not {number: faults for number, (_, faults) in checked.items() if faults}


@pytest.mark.parametrize("question", CHECKS)
def test_most_questions_are_answered(question):
    answers = [CHECKS[question](number)[0] for number in range(24)]
    open_ones = ("open", "at least", "interval", "time_limit", "converged")
    assert sum(answer not in open_ones for answer in answers) >= 18
