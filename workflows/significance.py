"""Sign tests of paired differences, and their correction where several are made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

SIGNIFICANT = 0.05


def exact_p(wins: ArrayLike, losses: ArrayLike) -> np.ndarray:
    """Return p-values of the exact two-sided sign test; of right and wrong poses, McNemar's test."""
    from scipy.stats import binom

    return np.minimum(1.0, 2.0 * binom.cdf(np.minimum(wins, losses), np.add(wins, losses), 0.5))


def sign_test(better: int, worse: int) -> tuple[str, float]:
    """Return the verdict on paired differences, and its p-value: ``unclear`` if not significant."""
    if better == worse == 0:
        return "same", np.nan
    p_value = float(exact_p(better, worse))
    if p_value < SIGNIFICANT:
        return "worse" if worse > better else "better", p_value
    return "unclear", p_value


def holm(p_of: Sequence[float], level: float = SIGNIFICANT) -> list[float]:
    """Return the level of each test, which is significant if its p-value is at most this level."""
    order = np.argsort(p_of, kind="stable")
    levels = [0.0] * len(order)
    stopped = None
    for rank, index in enumerate(order):
        share = level / (len(order) - rank) if stopped is None else stopped
        levels[index] = share
        if stopped is None and p_of[index] > share:
            stopped = share
    return levels
