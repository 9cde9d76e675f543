"""Estimates, their intervals and p-values, and the rule that turns them into decisions.

All verdicts follow from one rule. The rule is valid however often the results are examined, so blocks of
runs can be added until a claim is decided:

- A comparison has one estimate, over trials: the instances of a trial share their pose, so only trials
  are independent. The true value is that for these shapes under random poses and disturbances. The
  intervals form a confidence sequence: with probability at least 1 - level, those for all numbers of
  trials contain the true value. The p-value of a side is the smallest level at which the interval lies
  entirely on that side, so p-values and intervals always agree. It is the inverse of an e-value:

  - shares: beta-binomial mixture (Robbins, *Ann. Math. Statist.* 41, 1970), exact for independent
    trials. A trial may have a share between 0 and 1, because its likelihood ratio is convex in it;
  - medians: the same mixture for the share of trials on either side;
  - all other estimates: the t-statistic with a normal prior on the effect (Wang and Ramdas, *Sequential
    Anal.* 44, 2025). It is exact for means of normal values and holds asymptotically for others, as in a
    central limit theorem (Waudby-Smith et al., *Ann. Statist.* 52, 2024). The standard error is that of
    bootstrap draws.

  One counterexample refutes a maximum. It is confirmed once `ALIKE` of all trials are shown below it.
- Within a claim, Holm's procedure keeps the probability of any wrong decision below `LEVEL`. In the
  order of their p-values, comparison i of m is decided at ``LEVEL / (m - i + 1)``; the procedure stops
  at the first comparison that is not decided. Each interval is shown at the level that decides it.
- Comparisons with fewer than `MIN_TRIALS` trials are not decided. They take part in the correction, as do
  planned ones without runs (`reports.ledger.planned`): their number must not depend on the moment.
- `needed` estimates from the observed effect and spread how many trials decide an open comparison.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.special import betaln, xlog1py, xlogy
from scipy.stats import norm

DRAWS = 2000  # of the bootstrap
SEED = 20260326
MIN_TRIALS = 20  # fewer decide nothing, however many instances they have
MIN_SPREAD = 5  # fewer trials give no estimate of the spread
MOST_NEEDED = 10_000  # larger estimates are shown as "more than"
LEVEL = 0.05
POWER = 0.8
DECIMALS = 12  # of estimates; removes slopes that are only rounding errors
# Variance of the prior of an effect, in squared standard deviations of one trial. Compared with those
# for a fixed number of trials, intervals are narrowest at about 15 / PRIOR trials.
PRIOR = 0.3
# Share of trials that must be shown to agree before values without any spread decide.
ALIKE = 0.75
BETA = 0.5  # both parameters of the prior of a share

TIME_OUTS = "time-outs could change the verdict: use a longer limit"  # why a value of work is open
REPRODUCED, NOT, OPEN, NOT_RUN = "reproduced", "not reproduced", "open", "not run"
VERDICTS = (REPRODUCED, NOT, OPEN, NOT_RUN)

Claimed = Mapping[str, Any]  # side -> threshold


class Estimate(Protocol):
    """An estimate from `n` trials."""

    @property
    def value(self) -> float: ...

    @property
    def n(self) -> int: ...

    def interval(self, level: float) -> tuple[float, float]:
        """Return the interval of the confidence sequence with coverage 1 - level."""

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        """Return the p-values of lying above and of lying below a threshold.

        A tie with the threshold counts as below if `tie_below`, else as above.
        """

    def needed(self, threshold: float, level: float) -> int | None:
        """Return how many trials decide on which side of the threshold the true value lies."""

    def least(self, threshold: float, level: float) -> int:
        """Return how many trials decide it if all are as far on its side as possible."""


@dataclass(frozen=True)
class Figure:
    """A function of means, with the standard deviation of the contribution of one trial."""

    value: float
    n: int
    deviation: float

    def interval(self, level: float) -> tuple[float, float]:
        width = _critical_t(self.n, level)
        if self.deviation == 0.0:  # the values agree, so that only unseen ones could differ
            width = 0.0 if _p_of_share(1.0, self.n, ALIKE) <= level else np.inf
        if np.isinf(width) or not np.isfinite(self.value):
            return -np.inf, np.inf
        half = width * self.deviation / np.sqrt(self.n)
        return self.value - half, self.value + half

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        distance = self.value - threshold
        if np.isnan(distance):
            return 1.0, 1.0
        is_below = distance < 0 or (distance == 0 and tie_below)
        if self.deviation == 0.0:
            return _sides(_p_of_share(1.0, self.n, ALIKE), is_below)
        return _sides(_p_of_t(self.n, np.sqrt(self.n) * distance / self.deviation), is_below)

    def needed(self, threshold: float, level: float) -> int | None:
        distance, margin = abs(self.value - threshold), norm.isf(1 - POWER)
        if not np.isfinite(distance) or not np.isfinite(self.deviation):
            return None
        if self.deviation == 0.0:
            return Share(1.0, self.n).needed(ALIKE, level)
        return _least_number(
            lambda n: np.sqrt(n) * distance >= (_critical_t(n, level) + margin) * self.deviation
        )

    def least(self, threshold: float, level: float) -> int:
        return _least_number(lambda n: np.isfinite(_critical_t(n, level)))


@dataclass(frozen=True)
class Share:
    """A mean of values between 0 and 1: of a trial, the share of its instances with the value 1."""

    value: float
    n: int
    deviation: float | None = None  # of one trial; None: as if all values were 0 or 1

    def interval(self, level: float) -> tuple[float, float]:
        return self._end(level, 0.0), self._end(level, 1.0)

    def _end(self, level: float, outside: float) -> float:
        """Return the end of the interval between the value and 0 or 1, by bisection."""
        inside = self.value
        for _ in range(60):
            middle = 0.5 * (inside + outside)
            if _p_of_share(self.value, self.n, middle) <= level:
                outside = middle
            else:
                inside = middle
        return outside

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        is_below = self.value <= threshold if tie_below else self.value < threshold
        return _sides(_p_of_share(self.value, self.n, threshold), is_below)

    def needed(self, threshold: float, level: float) -> int | None:
        away = np.sign(self.value - threshold)
        spread = (
            np.sqrt(self.value * (1 - self.value)) if self.deviation is None else self.deviation
        )
        margin = norm.isf(1 - POWER) * spread

        def is_shown(n: int) -> bool:
            unlucky = self.value - away * margin / np.sqrt(n)
            is_beyond = away * (unlucky - threshold) > 0
            return is_beyond and _p_of_share(unlucky, n, threshold) <= level

        return _least_number(is_shown)

    def least(self, threshold: float, level: float) -> int:
        return Share(float(self.value >= threshold), 1).needed(threshold, level) or MIN_TRIALS


@dataclass(frozen=True)
class Median:
    """The median of sorted values."""

    ordered: np.ndarray

    @property
    def value(self) -> float:
        return float(np.median(self.ordered))

    @property
    def n(self) -> int:
        return len(self.ordered)

    def interval(self, level: float) -> tuple[float, float]:
        count = next(
            (c for c in range(self.n // 2 + 1, self.n + 1) if self._p_of(c) <= level), None
        )  # minimum number of values on one side of a point that excludes it as the median
        if count is None:
            return -np.inf, np.inf
        return float(self.ordered[self.n - count]), float(self.ordered[count - 1])

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        below = int(np.searchsorted(self.ordered, threshold, "right" if tie_below else "left"))
        return _sides(self._p_of(below), 2 * below >= self.n)

    def needed(self, threshold: float, level: float) -> int | None:
        # ties may count for the other side
        most = max((self.ordered > threshold).mean(), (self.ordered < threshold).mean())
        return Share(float(most), self.n).needed(0.5, level) if most > 0.5 else MOST_NEEDED

    def least(self, threshold: float, level: float) -> int:
        return Share(1.0, 1).least(0.5, level)

    def _p_of(self, count: int) -> float:
        return _p_of_share(count / self.n, self.n, 0.5)


@dataclass(frozen=True)
class Exact:
    """A maximum: one larger value refutes it. That no trial exceeds it is shown as for `ALIKE` values."""

    value: float
    n: int

    def interval(self, level: float) -> tuple[float, float]:
        return self.value, self.value

    def tails(self, threshold: float, *, tie_below: bool) -> tuple[float, float]:
        is_below = self.value <= threshold if tie_below else self.value < threshold
        return _sides(_p_of_share(1.0, self.n, ALIKE) if is_below else 0.0, is_below)

    def needed(self, threshold: float, level: float) -> int | None:
        return MIN_TRIALS if self.value > threshold else Share(1.0, self.n).needed(ALIKE, level)

    def least(self, threshold: float, level: float) -> int:
        return Share(1.0, 1).least(ALIKE, level)


class Extremes(NamedTuple):
    """The minimum and the maximum estimate that the tables allow, and the reason for the range."""

    least: Estimate
    most: Estimate
    because: str


def _sides(p: float, is_below: bool) -> tuple[float, float]:
    """Return the p-values of lying above and of lying below."""
    return (1.0, p) if is_below else (p, 1.0)


def _p_of_t(n: int, t: float) -> float:
    """Return the p-value of a t-statistic of `n` trials."""
    if n < 2:
        return 1.0
    widened, x = 1.0 + n * PRIOR, t**2 / (n - 1)
    ratio = widened if np.isinf(x) else (1.0 + x) / (1.0 + x / widened)
    return float(min(1.0, np.exp(0.5 * (np.log(widened) - n * np.log(ratio)))))


def _critical_t(n: int, level: float) -> float:
    """Return the minimum t-statistic whose p-value is at most `level`."""
    widened = 1.0 + n * PRIOR
    ratio = (np.sqrt(widened) / level) ** (2.0 / n)
    if n < 2 or ratio >= widened:
        return np.inf
    return float(np.sqrt((n - 1) * (ratio - 1.0) / (1.0 - ratio / widened)))


def _p_of_share(share: float, n: int, threshold: float) -> float:
    """Return the p-value of an observed share among `n` trials if the true share is `threshold`."""
    ones = share * n
    log_e = betaln(BETA + ones, BETA + n - ones) - betaln(BETA, BETA)
    log_e -= xlogy(ones, threshold) + xlog1py(n - ones, -threshold)
    return float(min(1.0, np.exp(-log_e)))


def _least_number(is_shown: Callable[[int], bool]) -> int:
    """Return the minimum sufficient number of trials, from `MIN_TRIALS` to `MOST_NEEDED`."""
    low, high = MIN_TRIALS, MOST_NEEDED
    if is_shown(low) or not is_shown(high):
        return low if is_shown(low) else high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_shown(middle) else (middle, high)
    return high


@lru_cache(maxsize=6)
def _weights(n: int) -> np.ndarray:
    """Return the share of each of `n` trials in each bootstrap draw, (draws, n)."""
    drawn = np.random.default_rng(SEED).multinomial(n, np.full(n, 1 / n), size=DRAWS)
    return (drawn / n).astype(np.float64)


def of_means(statistic: Callable[[np.ndarray], np.ndarray], columns: np.ndarray) -> Figure:
    """Return the estimate of a statistic of the means of `columns` (trials × quantities).

    `statistic` maps means (draws × quantities) to a number per draw. Draws without a value (NaN) are left
    out. If only some of the others are finite, the deviation is infinite.
    """
    n = len(columns)
    with np.errstate(all="ignore"):
        drawn = np.round(statistic(_weights(n) @ columns), DECIMALS)
        value = round(float(statistic(columns.mean(axis=0)[None])[0]), DECIMALS)
    drawn = drawn[~np.isnan(drawn)]
    if len(drawn) == 0 or (drawn == drawn[0]).all():
        return Figure(value, n, 0.0)
    # the draws have the standard deviation for a divisor of n; correct it to n - 1
    per_trial = n / np.sqrt(n - 1)
    return Figure(value, n, drawn.std() * per_trial if np.isfinite(drawn).all() else np.inf)


def mean(values: np.ndarray) -> Figure:
    return of_means(lambda means: means[:, 0], values[:, None])


def ratio(above: np.ndarray, below: np.ndarray) -> Figure:
    """Return the ratio of the means of paired values."""
    return of_means(lambda means: means[:, 0] / means[:, 1], np.column_stack([above, below]))


def median(values: np.ndarray) -> Median:
    return Median(np.sort(values))


def share(values: np.ndarray) -> Share:
    spread = float(values.std(ddof=1)) if len(values) > 1 else None
    return Share(float(values.mean()), len(values), spread)


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
    """Return the p-values of lying on the claimed side and of lying on the other side.

    If it `rises` (`falls`), runs at a limit could increase (decrease) the value, so it cannot be shown to
    lie below (above) a threshold. The minimum of `extremes` decides about above, the maximum about below.
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


def decide(on_it: float, on_the_other: float, level: float) -> str:
    """Return the verdict (reproduced, not reproduced or open) from the two p-values."""
    return REPRODUCED if on_it <= level else NOT if on_the_other <= level else OPEN


def needed(estimate: Estimate, claimed: Claimed, level: float) -> int | None:
    """Return how many trials decide the comparison with probability `POWER`; None if unknown.

    It is unknown for fewer than `MIN_SPREAD` trials and without a spread, and at most `MOST_NEEDED`.
    """
    if estimate.n < MIN_SPREAD:
        return None
    return estimate.needed(_nearest(estimate, claimed), level)


def least(estimate: Estimate, claimed: Claimed, level: float) -> int:
    """Return the minimum number of trials that can decide the comparison."""
    return estimate.least(_nearest(estimate, claimed), level)


def _nearest(estimate: Estimate, claimed: Claimed) -> float:
    """Return the threshold, of two the nearest."""
    ((_, threshold),) = claimed.items()
    return float(min(np.atleast_1d(threshold), key=lambda end: abs(end - estimate.value)))


def distance(estimate: Estimate, claimed: Claimed) -> float:
    """Return how far the value lies on the claimed side, negative on the other side.

    Of several comparisons, the minimum is shown.
    """
    ((side, threshold),) = claimed.items()
    if side in ("below", "at_most"):
        return threshold - estimate.value
    if side in ("above", "at_least"):
        return estimate.value - threshold
    return min(estimate.value - threshold[0], threshold[1] - estimate.value)
