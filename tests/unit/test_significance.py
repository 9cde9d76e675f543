"""Sign tests need enough evidence, and several of them more."""

from __future__ import annotations

import numpy as np
import pytest

from workflows.significance import SIGNIFICANT, holm, sign_test


def test_sign_test_needs_enough_evidence():
    assert sign_test(0, 0)[0] == "same"
    assert sign_test(0, 3) == ("unclear", 0.25)
    assert sign_test(0, 6)[0] == "worse"
    assert sign_test(9, 1)[0] == "better"


def test_holm_decides_the_smallest_first_and_stops_at_the_first_open_one():
    levels = holm([0.04, 0.001, 0.013, 0.5])
    assert levels == pytest.approx(
        [SIGNIFICANT / 2, SIGNIFICANT / 4, SIGNIFICANT / 3, SIGNIFICANT / 2]
    )
    p = [0.04, 0.001, 0.013, 0.5]
    assert [a <= b for a, b in zip(p, levels, strict=True)] == [False, True, True, False]
    assert holm([]) == []
    # none after the first open one is decided, however much its own level would allow
    p = [0.02, 0.03, 0.04]
    assert not any(a <= b for a, b in zip(p, holm(p), strict=True))


def test_holm_keeps_the_probability_of_a_wrong_decision():
    """Ten p-values without an effect: uncorrected, four in ten claims would have a wrong decision."""
    rng = np.random.default_rng(3)
    wrong, uncorrected = 0, 0
    for p in rng.random((400, 10)):
        uncorrected += p.min() <= SIGNIFICANT
        wrong += any(a <= b for a, b in zip(p, holm(p), strict=True))
    assert wrong <= 0.08 * 400 < 0.3 * 400 <= uncorrected
