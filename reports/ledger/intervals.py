"""Confidence intervals (bootstrap, Wilson for shares) and their verdict on a claimed side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest

DRAWS = 2000
SEED = 20260326
MIN_INSTANCES = 5  # fewer make an interval inconclusive
COVERED = (0.025, 0.975)
DECIMALS = 12  # removes slopes that are rounding only

REPRODUCED, NOT, OPEN, NOT_RUN = "reproduced", "not reproduced", "inconclusive", "not run"
VERDICTS = (REPRODUCED, NOT, OPEN, NOT_RUN)


@dataclass(frozen=True)
class Interval:
    """A figure with its 95 % interval over `n` instances."""

    value: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


def bootstrap(statistic: Callable[[np.ndarray], np.ndarray], n: int) -> Interval:
    """Return the interval of `statistic`, which maps rows of indices (draws × n) to a number per row."""
    rng = np.random.default_rng(SEED)
    drawn = np.concatenate(
        [statistic(rng.integers(n, size=(part, n))) for part in (DRAWS // 4,) * 4]
    )
    low, high = np.nanquantile(drawn, COVERED)
    value, low, high = (
        round(float(end), DECIMALS) for end in (statistic(np.arange(n)[None])[0], low, high)
    )
    return Interval(value, low, high, n)


def mean(values: np.ndarray) -> Interval:
    """Return the interval of the mean."""
    return bootstrap(lambda rows: values[rows].mean(axis=1), len(values))


def share(values: np.ndarray) -> Interval:
    """Return the share of ones with Wilson's interval: a bootstrap of ones only has no width."""
    found = binomtest(int(values.sum()), len(values))
    ends = found.proportion_ci(COVERED[1] - COVERED[0], method="wilson")
    return Interval(float(values.mean()), float(ends.low), float(ends.high), len(values))


def median(values: np.ndarray) -> Interval:
    """Return the interval of the median."""
    return bootstrap(lambda rows: np.median(values[rows], axis=1), len(values))


def maximum(values: np.ndarray) -> Interval:
    """Return the maximum without an interval: one counterexample is enough."""
    most = float(values.max())
    return Interval(most, most, most, len(values))


def ratio(above: np.ndarray, below: np.ndarray) -> Interval:
    """Return the interval of the ratio of means of paired values."""
    return bootstrap(lambda rows: above[rows].mean(axis=1) / below[rows].mean(axis=1), len(above))


# side -> (entirely on the claimed side, entirely on the other); a tie is neither below nor above
_SIDES: dict[str, Callable[[Interval, Any], tuple[bool, bool]]] = {
    "below": lambda i, t: (i.high < t, i.low >= t),
    "above": lambda i, t: (i.low > t, i.high <= t),
    "at_most": lambda i, t: (i.high <= t, i.low > t),
    "at_least": lambda i, t: (i.low >= t, i.high < t),
    "within": lambda i, t: (i.low >= t[0] and i.high <= t[1], i.low > t[1] or i.high < t[0]),
}


def judge(interval: Interval, claimed: Mapping[str, Any]) -> str:
    """Return reproduced, not reproduced or inconclusive, by the side on which the interval lies."""
    if interval.n < MIN_INSTANCES:
        return OPEN
    ((side, threshold),) = claimed.items()
    on_it, on_the_other = _SIDES[side](interval, threshold)
    return REPRODUCED if on_it else NOT if on_the_other else OPEN


def distance(interval: Interval, claimed: Mapping[str, Any]) -> float:
    """Return how far the figure lies inside the claimed side; of several, the minimum is shown."""
    ((side, threshold),) = claimed.items()
    if side in ("below", "at_most"):
        return threshold - interval.value
    if side in ("above", "at_least"):
        return interval.value - threshold
    return min(interval.value - threshold[0], threshold[1] - interval.value)
