"""Estimates, their intervals and p-values, and the rule that turns them into decisions.

All verdicts follow from one rule:

- A comparison has one figure. Its interval is over instances: bootstrap percentiles, or Wilson's
  interval for shares. The p-value of a side is the smallest level at which the interval lies
  entirely on that side, so that p-values and intervals always agree. A maximum over runs has no interval:
  one counterexample decides.
- Within a claim, Holm's procedure keeps the probability of any wrong decision below `LEVEL`. In the
  order of their p-values, comparison i of m is decided at ``LEVEL / (m - i + 1)``; the procedure stops
  at the first comparison that is not decided. Each interval is shown at the level that decides it.
- Comparisons with fewer than `MIN_INSTANCES` instances are not decided and take no part in the
  correction.
- `needed` estimates how many instances decide an open comparison, from the effect and the spread
  observed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.stats import norm

DRAWS = 5000
SEED = 20260326
MIN_INSTANCES = 20  # fewer decide nothing
MIN_SPREAD = 5  # fewer instances give no estimate of the spread
MOST_NEEDED = 10_000  # larger estimates are shown as "more than"
LEVEL = 0.05
POWER = 0.8
DECIMALS = 12  # removes slopes that are rounding only

TIME_OUTS = "time-outs could change the verdict: use a longer limit"  # why a figure of work is open
REPRODUCED, NOT, OPEN, NOT_RUN = "reproduced", "not reproduced", "open", "not run"
VERDICTS = (REPRODUCED, NOT, OPEN, NOT_RUN)

Claimed = Mapping[str, Any]  # side -> threshold


class Estimate(Protocol):
    """A figure over `n` instances."""

    @property
    def value(self) -> float: ...

    @property
    def n(self) -> int: ...

    def interval(self, level: float) -> tuple[float, float]:
        """Return the interval with coverage 1 - level."""

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        """Return the two-sided p-values of lying above and of lying below a threshold.

        A tie counts as below, or as above.
        """

    def spread(self, threshold: float) -> tuple[float, float]:
        """Return standard deviations of one instance: if the threshold is true, and as observed."""


@dataclass(frozen=True)
class Bootstrapped:
    """A figure with its sorted bootstrap draws."""

    value: float
    n: int
    draws: np.ndarray

    def interval(self, level: float) -> tuple[float, float]:
        kept = self.draws
        at = int(level / 2 * (len(kept) + 1) * (1 + 1e-9))  # order statistic; agrees with `tails`
        return (float(kept[at - 1]), float(kept[-at])) if at else (-np.inf, np.inf)

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        below = np.searchsorted(self.draws, threshold, side="right" if tie_below else "left")
        count = len(self.draws)
        shares = np.array([below, count - below]) + 1.0  # against "above", against "below"
        above_p, below_p = np.minimum(1.0, 2 * shares / (count + 1))
        return float(above_p), float(below_p)

    def spread(self, threshold: float) -> tuple[float, float]:
        finite = self.draws[np.isfinite(self.draws)]
        each = float(finite.std() * np.sqrt(self.n)) if len(finite) else np.nan
        return each, each


@dataclass(frozen=True)
class Share:
    """A share of ones with Wilson's interval: the bootstrap of ones only has no width."""

    value: float
    n: int

    def interval(self, level: float) -> tuple[float, float]:
        z, p, n = norm.isf(level / 2), self.value, self.n
        centre, half = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
        low, high = ((centre + sign * half) / (1 + z**2 / n) for sign in (-1, 1))
        return max(0.0, float(low)), min(1.0, float(high))

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        error = np.sqrt(threshold * (1 - threshold) / self.n)
        z = (self.value - threshold) / error if error > 0 else np.inf
        p = float(2 * norm.sf(abs(z)))
        return (p, 1.0) if self.value > threshold else (1.0, p)

    def spread(self, threshold: float) -> tuple[float, float]:
        return tuple(float(np.sqrt(p * (1 - p))) for p in (threshold, self.value))  # type: ignore[return-value]


@dataclass(frozen=True)
class Exact:
    """A figure without an interval, such as a maximum."""

    value: float
    n: int

    def interval(self, level: float) -> tuple[float, float]:
        return self.value, self.value

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        is_below = self.value <= threshold if tie_below else self.value < threshold
        return (1.0, 0.0) if is_below else (0.0, 1.0)

    def spread(self, threshold: float) -> tuple[float, float]:
        return np.nan, np.nan


class Extremes(NamedTuple):
    """The least and the greatest figure that the tables allow, and why they show no more."""

    least: Estimate
    most: Estimate
    because: str


@lru_cache(maxsize=6)
def _weights(n: int) -> np.ndarray:
    """Return how often each of `n` instances is in each draw, as shares."""
    drawn = np.random.default_rng(SEED).multinomial(n, np.full(n, 1 / n), size=DRAWS)
    return (drawn / n).astype(np.float64)


def of_means(statistic: Callable[[np.ndarray], np.ndarray], columns: np.ndarray) -> Bootstrapped:
    """Return the estimate of a statistic of the means of `columns` (instances × quantities).

    `statistic` maps means (draws × quantities) to a number per draw.
    """
    n = len(columns)
    with np.errstate(all="ignore"):
        drawn = np.round(statistic(_weights(n) @ columns), DECIMALS)
        value = round(float(statistic(columns.mean(axis=0)[None])[0]), DECIMALS)
    return Bootstrapped(value, n, np.sort(drawn[~np.isnan(drawn)]))


def mean(values: np.ndarray) -> Bootstrapped:
    return of_means(lambda means: means[:, 0], values[:, None])


def ratio(above: np.ndarray, below: np.ndarray) -> Bootstrapped:
    """Return the ratio of the means of paired values."""
    return of_means(lambda means: means[:, 0] / means[:, 1], np.column_stack([above, below]))


def median(values: np.ndarray) -> Bootstrapped:
    n = len(values)
    ordered = np.sort(values)
    reached = np.cumsum(_weights(n), axis=1) >= 0.5 - 1e-9
    drawn = ordered[reached.argmax(axis=1)]
    return Bootstrapped(float(np.median(values)), n, np.sort(drawn))


def share(values: np.ndarray) -> Share:
    return Share(float(values.mean()), len(values))


def maximum(values: np.ndarray) -> Exact:
    return Exact(float(values.max()), len(values))


# side -> whether a tie with the threshold counts as below it
_TIE_BELOW = {"below": False, "at_most": True, "above": True, "at_least": False}


def p_values(
    estimate: Estimate,
    claimed: Claimed,
    *,
    rises: bool = False,
    falls: bool = False,
    extremes: Extremes | None = None,
) -> tuple[float, float]:
    """Return the p-values of lying on the claimed side, and on the other one.

    `rises` and `falls`: runs at a limit could increase or decrease the figure, so it cannot be shown to
    lie below, or above, anything. `extremes`: the least figure shows that it lies above a
    threshold, the greatest one that it lies below.
    """
    ((side, threshold),) = claimed.items()
    least, most = (extremes.least, extremes.most) if extremes else (estimate, estimate)

    def tails(at: float, tie_below: bool) -> tuple[float, float]:
        return least.tails(at, tie_below=tie_below)[0], most.tails(at, tie_below=tie_below)[1]

    if side == "within":
        low, high = threshold
        above_low, below_low = tails(low, False)
        above_high, below_high = tails(high, True)
        if rises:
            below_low = below_high = 1.0
        if falls:
            above_low = above_high = 1.0
        return max(above_low, below_high), min(below_low, above_high)
    above, below = tails(threshold, _TIE_BELOW[side])
    above, below = 1.0 if falls else above, 1.0 if rises else below
    return (below, above) if side in ("below", "at_most") else (above, below)


def holm(p_of: Sequence[float]) -> list[float]:
    """Return the level at which each comparison is decided; decided are those with p <= level."""
    order = np.argsort(p_of, kind="stable")
    levels = [0.0] * len(order)
    stopped = None
    for rank, index in enumerate(order):
        level = LEVEL / (len(order) - rank) if stopped is None else stopped
        levels[index] = level
        if stopped is None and p_of[index] > level:
            stopped = level
    return levels


def decide(on_it: float, on_the_other: float, level: float) -> str:
    """Return reproduced, not reproduced or open from the two p-values."""
    return REPRODUCED if on_it <= level else NOT if on_the_other <= level else OPEN


def needed(estimate: Estimate, claimed: Claimed, level: float) -> int | None:
    """Return how many instances decide the comparison with probability `POWER`; None if unknown.

    It is unknown for fewer than `MIN_SPREAD` instances and without a spread. Effects near 0 need more
    than `MOST_NEEDED` instances, which is then returned.
    """
    if estimate.n < MIN_SPREAD:
        return None
    ((_, threshold),) = claimed.items()
    nearest = min(np.atleast_1d(threshold), key=lambda end: abs(end - estimate.value))
    distance = abs(float(nearest) - estimate.value)
    if_true, observed = estimate.spread(float(nearest))
    spread = norm.isf(level / 2) * if_true + norm.isf(1 - POWER) * observed
    if not np.isfinite(spread) or not np.isfinite(distance):
        return None
    if spread == 0:
        return MIN_INSTANCES
    if distance * np.sqrt(MOST_NEEDED) <= spread:
        return MOST_NEEDED
    return max(MIN_INSTANCES, int(np.ceil((spread / distance) ** 2)))


def distance(estimate: Estimate, claimed: Claimed) -> float:
    """Return how far the figure lies inside the claimed side; of several, the minimum is shown."""
    ((side, threshold),) = claimed.items()
    if side in ("below", "at_most"):
        return threshold - estimate.value
    if side in ("above", "at_least"):
        return estimate.value - threshold
    return min(estimate.value - threshold[0], threshold[1] - estimate.value)
