"""Verdicts on times: paired, robust, and only within one machine.

`judge` takes the table of `tests.bench.interleaved`, in which two versions solve the same problems in
turn, many times. The statistic of a repetition is the mean logarithm of the ratio head / base over the
problems. Its Hodges-Lehmann estimate over the repetitions, with the interval of Wilcoxon's signed-rank
test, changes little if a few repetitions are disturbed. A version is slower if the whole interval is
above `MARGIN`.

`judge_once` takes times that were measured once per instance, on different days. They depend on the load
of the machine, so only a factor of `ONCE_MARGIN` counts as a difference.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from workflows.outcomes import TIMED
from workflows.stages.worker import COUNTERS

CONFIDENCE = 0.95
MARGIN = 1.02  # smaller differences between two processes have other causes, such as memory layout
ONCE_MARGIN = 1.5
PRECISION = 0.03  # half width of an interval, as a share, at which repetitions end
FEWEST = 6  # with fewer pairs no interval of this confidence exists


@dataclass(frozen=True)
class Ratio:
    """Estimate and interval of a ratio of times head / base."""

    estimate: float
    low: float
    high: float
    pairs: int

    def verdict(self, margin: float) -> str:
        """Return ``slower``, ``faster``, ``same`` (the interval is within the margin) or ``unclear``."""
        if self.low > margin:
            return "slower"
        if self.high < 1 / margin:
            return "faster"
        return "same" if self.low >= 1 / margin and self.high <= margin else "unclear"

    def __str__(self) -> str:
        return (
            f"ratio {self.estimate:.3f} [{self.low:.3f}, {self.high:.3f}], "
            f"{CONFIDENCE:.0%} interval of {self.pairs} pairs"
        )


@dataclass(frozen=True)
class Timed:
    """The verdict on repeated CPU times of one group of problems."""

    group: str
    base_s: float  # median over repetitions of the mean over problems
    head_s: float
    ratio: Ratio
    noise: float  # typical relative difference of two repetitions of the base

    @property
    def verdict(self) -> str:
        return self.ratio.verdict(MARGIN)

    @property
    def summary(self) -> str:
        return f"{self.ratio}; noise of one repetition {self.noise:.1%}"


def hodges_lehmann(logs: np.ndarray) -> Ratio:
    """Return the ratio of which `logs` are paired logarithms, with its interval.

    The estimate is the median of all means of two values. The interval inverts Wilcoxon's signed-rank
    test; with fewer than `FEWEST` values it is unlimited.
    """
    n = len(logs)
    one, other = np.triu_indices(n)
    means = np.sort((logs[one] + logs[other]) / 2)
    estimate = float(np.exp(np.median(means)))
    if n < FEWEST:
        return Ratio(estimate, 0.0, np.inf, n)
    tail = _rank_below(n)
    return Ratio(estimate, float(np.exp(means[tail])), float(np.exp(means[-1 - tail])), n)


def _rank_below(n: int) -> int:
    """Return how many of the sorted means lie outside on each side."""
    if n > 50:
        from scipy.stats import norm

        spread = np.sqrt(n * (n + 1) * (2 * n + 1) / 24)
        return max(0, int(n * (n + 1) / 4 + norm.ppf((1 - CONFIDENCE) / 2) * spread) - 1)
    counts = np.ones(1)  # of subsets of the ranks 1 … n by their sum
    for rank in range(1, n + 1):
        counts = np.convolve(counts, np.r_[1.0, np.zeros(rank - 1), 1.0])
    below = np.cumsum(counts / counts.sum())
    return max(0, int(np.searchsorted(below, (1 - CONFIDENCE) / 2, side="right")) - 1)


def judge(times: pd.DataFrame) -> Iterator[Timed]:
    """Yield a verdict for each group of a table of repeated times."""
    for group, part in times.dropna(subset="cpu_s_base").groupby("group", sort=False):
        sides = part[["cpu_s_base", "cpu_s_head"]].apply(np.log)
        logs = sides.groupby(part["repetition"]).mean()
        base = logs["cpu_s_base"].to_numpy()
        by_repetition = logs["cpu_s_head"].to_numpy() - base
        means = part.groupby("repetition")[["cpu_s_base", "cpu_s_head"]].mean().median()
        yield Timed(
            str(group),
            float(means["cpu_s_base"]),
            float(means["cpu_s_head"]),
            hodges_lehmann(by_repetition),
            float(np.expm1(np.median(np.abs(np.diff(base))))) if len(base) > 1 else np.nan,
        )


def is_precise(times: pd.DataFrame) -> bool:
    """Tell whether more repetitions are of little use, because all intervals are narrow."""
    ratios = [timed.ratio for timed in judge(times)]
    return all(ratio.high <= ratio.low * (1 + PRECISION) ** 2 for ratio in ratios)


def judge_once(base: np.ndarray, head: np.ndarray) -> tuple[str, Ratio]:
    """Return the verdict on times that were measured once per instance, and their ratio."""
    ratio = hodges_lehmann(np.log(head) - np.log(base))
    return ratio.verdict(ONCE_MARGIN), ratio


@dataclass(frozen=True)
class Work:
    """The verdict on one counter, or on the statuses, of all problems of a table."""

    counter: str
    base: int
    head: int
    verdict: str  # same, better, worse, changed
    detail: str


def word_of_work(old: pd.Series, new: pd.Series) -> str:
    """Return the verdict on work that differs: worse if the sum rises, or more problems take more."""
    change, more, fewer = new.sum() - old.sum(), (new > old).sum(), (new < old).sum()
    if change > 0 or more > fewer:
        return "worse"
    return "changed" if change == 0 and more == fewer else "better"


def judge_work(times: pd.DataFrame, counters: Sequence[str] = COUNTERS) -> Iterator[Work]:
    """Yield a verdict for each counter; the work of a solve must repeat exactly.

    Work that a repetition of the head does not repeat is worse. If only the base does not repeat its
    work, the difference is `changed`.
    """
    first = times.drop_duplicates("problem")
    by_problem = times.groupby("problem", sort=False)
    for counter in counters:
        old, new = first[f"{counter}_base"], first[f"{counter}_head"]
        differing = int((old != new).sum())
        word = word_of_work(old, new)
        why = f"{differing} problems differ" if differing else ""
        for side, verdict in (("base", "changed"), ("head", "worse")):
            if unsteady := int((by_problem[f"{counter}_{side}"].nunique() > 1).sum()):
                word, differing = verdict, unsteady
                why = f"{unsteady} problems differ between repetitions of the {side}"
        yield Work(counter, int(old.sum()), int(new.sum()), word if differing else "same", why)


def judge_statuses(times: pd.DataFrame) -> Work:
    """Return the verdict on how the solves ended: an optimum that is no longer proven is worse.

    So is any new end by time or memory: these limits are far above what the problems need.
    """
    optimal = {side: times[f"status_{side}"].eq("optimal") for side in ("base", "head")}
    starved = times["status_head"].isin(TIMED) & ~times["status_base"].isin(TIMED)
    lost = (optimal["base"] & ~optimal["head"]) | starved
    differs = times["status_base"] != times["status_head"]
    word = "worse" if lost.any() else "changed" if differs.any() else "same"
    count = times.loc[lost if lost.any() else differs, "problem"].nunique()
    old, new = (int(optimal[side].sum()) for side in ("base", "head"))
    return Work("optimal", old, new, word, f"{count} problems end differently" if count else "")
