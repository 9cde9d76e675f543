"""Intervals, bootstrap but for shares, and what they say of a claimed side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest

DRAWS = 2000
SEED = 20260326
LEAST_PAIRS = 5  # with fewer instances an interval says nothing
COVERED = (0.025, 0.975)
DECIMALS = 12  # a slope of rounding alone is none

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
    """Interval of `statistic`, which maps rows of indices (draws × n) to one number a row."""
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
    """The mean."""
    return bootstrap(lambda rows: values[rows].mean(axis=1), len(values))


def share(values: np.ndarray) -> Interval:
    """The share of ones, with Wilson's interval: of draws from nothing but ones none has a zero."""
    found = binomtest(int(values.sum()), len(values))
    ends = found.proportion_ci(COVERED[1] - COVERED[0], method="wilson")
    return Interval(float(values.mean()), float(ends.low), float(ends.high), len(values))


def median(values: np.ndarray) -> Interval:
    """The median."""
    return bootstrap(lambda rows: np.median(values[rows], axis=1), len(values))


def greatest(values: np.ndarray) -> Interval:
    """The greatest value, which one counterexample decides: no other draw takes it back."""
    most = float(values.max())
    return Interval(most, most, most, len(values))


def ratio(above: np.ndarray, below: np.ndarray) -> Interval:
    """The ratio of means of paired values."""
    return bootstrap(lambda rows: above[rows].mean(axis=1) / below[rows].mean(axis=1), len(above))


# side -> (wholly on the claimed side, wholly on the other); a tie is not below, nor above
_SIDES: dict[str, Callable[[Interval, Any], tuple[bool, bool]]] = {
    "below": lambda i, t: (i.high < t, i.low >= t),
    "above": lambda i, t: (i.low > t, i.high <= t),
    "at_most": lambda i, t: (i.high <= t, i.low > t),
    "at_least": lambda i, t: (i.low >= t, i.high < t),
    "within": lambda i, t: (i.low >= t[0] and i.high <= t[1], i.low > t[1] or i.high < t[0]),
}


def judge(interval: Interval, claimed: Mapping[str, Any]) -> str:
    """Reproduced, not reproduced or inconclusive: where the interval lies, by the claimed side."""
    if interval.n < LEAST_PAIRS:
        return OPEN
    ((side, threshold),) = claimed.items()
    on_it, on_the_other = _SIDES[side](interval, threshold)
    return REPRODUCED if on_it else NOT if on_the_other else OPEN


def distance(interval: Interval, claimed: Mapping[str, Any]) -> float:
    """How far the figure lies inside the claimed side: the least one of several is shown."""
    ((side, threshold),) = claimed.items()
    if side in ("below", "at_most"):
        return threshold - interval.value
    if side in ("above", "at_least"):
        return interval.value - threshold
    return min(interval.value - threshold[0], threshold[1] - interval.value)
