"""Estimates, intervals, p-values and Holm's correction of the ledger of claims."""

from __future__ import annotations

import numpy as np
import pytest

from reports.ledger import intervals
from reports.ledger.intervals import LEVEL, MIN_TRIALS, MOST_NEEDED, NOT, OPEN, REPRODUCED

RNG = np.random.default_rng(5)
NORMAL = RNG.normal(1.0, 1.0, 60)


def decided(estimate, claimed, level=LEVEL):
    return intervals.decide(*intervals.p_values(estimate, claimed), level)


def test_statistics_have_the_values_of_their_names():
    values = np.array([0.0, 1.0, 2.0, 3.0, 94.0])
    for name, value in (("mean", 20.0), ("median", 2.0), ("maximum", 94.0)):
        assert getattr(intervals, name)(values).value == value
    assert intervals.ratio(values, np.full(5, 10.0)).value == 2.0
    assert intervals.share(np.array([1.0, 0.0, 1.0, 1.0])).value == 0.75


def plain_mean(values):
    return intervals.Figure(values.mean(), len(values), values.std(ddof=1))


LOOKS = np.arange(MIN_TRIALS, 301, 5)
# Values with a true figure of 1, and its estimate after n of them.
SEQUENCES = {
    "mean": (lambda rng: rng.normal(1.0, 2.0, 300), plain_mean),
    "skewed mean": (lambda rng: rng.exponential(1.0, 300), plain_mean),
    "share": (lambda rng: rng.random(300) < 0.8, intervals.share),
    "share of trials": (lambda rng: rng.beta(4.0, 1.0, 300), intervals.share),
    "median": (lambda rng: rng.exponential(1.0 / np.log(2.0), 300), intervals.median),
}  # fmt: skip


@pytest.mark.parametrize("name", SEQUENCES)
def test_intervals_hold_at_all_looks_together(name):
    """In 95 % of the sequences, none of the 57 intervals excludes the true figure."""
    draw, estimate = SEQUENCES[name]
    true = 0.8 if name.startswith("share") else 1.0
    rng, wrong = np.random.default_rng(1), 0
    for _ in range(200):
        values = draw(rng)
        p = [min(estimate(values[:n]).tails(true, tie_below=True)) for n in LOOKS]
        wrong += min(p) <= LEVEL
    assert wrong <= 0.08 * 200  # 10 expected at most; a skewed mean has a few more


def test_intervals_for_one_look_do_not_hold_at_all_looks():
    """The test above would find an interval that is not made for repeated looks."""
    rng, wrong = np.random.default_rng(1), 0
    for _ in range(200):
        means = np.cumsum(rng.normal(0.0, 1.0, 300))[LOOKS - 1] / LOOKS
        wrong += bool((np.abs(means) > 1.96 / np.sqrt(LOOKS)).any())
    assert wrong > 0.2 * 200


def test_deviation_of_a_mean_is_that_of_its_values():
    assert intervals.mean(NORMAL).deviation == pytest.approx(NORMAL.std(ddof=1), rel=0.05)


def test_ends_of_the_median_are_observed_values():
    found = intervals.median(NORMAL)
    low, high = found.interval(LEVEL)
    assert low < 1.0 < high
    assert {low, high} <= set(NORMAL)
    assert intervals.median(NORMAL[:5]).interval(LEVEL) == (-np.inf, np.inf)


def test_draws_without_a_finite_value_leave_a_comparison_open():
    """One of 30 denominators is not 0, so some bootstrap draws have only zeros."""
    unclear = intervals.ratio(np.ones(30), np.eye(30)[0])
    assert decided(unclear, {"above": 1.0}) == OPEN
    clear = intervals.ratio(np.ones(30), np.zeros(30))
    assert decided(clear, {"above": 1.0}) == REPRODUCED


ESTIMATES = {
    "mean": intervals.mean(NORMAL),
    "ratio": intervals.ratio(NORMAL + 5, np.roll(NORMAL, 1) + 5),
    "share": intervals.share((NORMAL > 0.5).astype(float)),
    "median": intervals.median(NORMAL),
    "tie": intervals.mean(np.ones(30)),
}


@pytest.mark.parametrize("name", ESTIMATES)
@pytest.mark.parametrize("side", ["below", "above", "at_most", "at_least"])
@pytest.mark.parametrize("level", [0.05, 0.01, 0.002])
def test_p_values_and_intervals_agree(name, side, level):
    """A p-value is within a level exactly if the interval of that level lies on the side."""
    estimate = ESTIMATES[name]
    low, high = estimate.interval(level)
    most = 0.95 if name == "share" else 1.7
    for threshold in np.linspace(0.3, most, 57):
        on_it, on_the_other = intervals.p_values(estimate, {side: threshold})
        sides = {
            "below": (high < threshold, low >= threshold),
            "at_most": (high <= threshold, low > threshold),
            "above": (low > threshold, high <= threshold),
            "at_least": (low >= threshold, high < threshold),
        }
        assert (on_it <= level, on_the_other <= level) == sides[side], threshold


@pytest.mark.parametrize(
    ("value", "verdict"), [(1.0, REPRODUCED), (0.8, REPRODUCED), (1.3, NOT), (0.7, NOT)]
)
def test_a_range_is_claimed_from_both_sides(value, verdict):
    assert decided(intervals.mean(np.full(30, value)), {"within": [0.8, 1.25]}) == verdict
    wide = intervals.mean(value + 3 * (NORMAL - NORMAL.mean()))
    assert decided(wide, {"within": [0.8, 1.25]}) == OPEN


def test_runs_at_a_limit_forbid_the_side_that_they_could_leave():
    low, high = intervals.mean(np.full(30, 0.5)), intervals.mean(np.full(30, 2.0))
    cases = {("below", "rises"): low, ("above", "falls"): high}
    for (side, flag), estimate in cases.items():
        assert intervals.p_values(estimate, {side: 1.0}, **{flag: True})[0] == 1.0
        other = "falls" if flag == "rises" else "rises"
        assert intervals.p_values(estimate, {side: 1.0}, **{other: True})[0] < LEVEL
    claimed = {"within": [0.8, 1.25]}
    assert intervals.p_values(low, claimed, rises=True)[1] == 1.0
    assert intervals.p_values(low, claimed, falls=True)[1] < LEVEL
    inside = intervals.mean(np.ones(30))
    for flag in ("rises", "falls"):
        assert intervals.p_values(inside, claimed, **{flag: True})[0] == 1.0


@pytest.mark.parametrize("threshold", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("ones", [0, 3, 7])
def test_a_share_within_a_trial_shows_less_than_whole_trials(threshold, ones):
    """The e-value of a trial with a share is at most the mean of those with 0 and 1."""

    def e_value(last: float) -> float:
        return (
            1.0
            / intervals.share(np.array([1.0] * ones + [0.0] * (7 - ones) + [last])).tails(
                threshold, tie_below=(ones + last) / 8 <= threshold
            )[(ones + last) / 8 <= threshold]
        )

    ends = e_value(0.0), e_value(1.0)
    for share in (0.25, 0.5, 0.75):
        assert e_value(share) <= max(1.0, (1 - share) * ends[0] + share * ends[1]) + 1e-9


def test_few_successes_do_not_show_a_share():
    claimed = {"at_least": 0.9}
    assert decided(intervals.share(np.ones(40)), claimed) == OPEN
    assert decided(intervals.share(np.ones(60)), claimed) == REPRODUCED
    assert decided(intervals.share(np.zeros(6)), claimed) == NOT


def test_a_maximum_is_decided_by_one_counterexample():
    none, one = intervals.maximum(np.zeros(30)), intervals.maximum(np.eye(30)[0])
    assert decided(none, {"at_most": 0}) == REPRODUCED
    assert decided(one, {"at_most": 0}) == NOT


def test_the_needed_number_decides_about_as_often_as_stated():
    rng = np.random.default_rng(8)
    pilot = rng.normal(0.3, 1.0, 30)
    pilot += 0.3 - pilot.mean()
    count = intervals.needed(intervals.mean(pilot), {"above": 0.0}, LEVEL)
    hits = [
        decided(intervals.mean(rng.normal(0.3, pilot.std(), count)), {"above": 0.0}) == REPRODUCED
        for _ in range(100)
    ]
    assert 0.65 <= np.mean(hits) <= 0.95


def test_the_needed_number_is_honest_about_what_is_not_known():
    assert intervals.needed(intervals.mean(NORMAL[:4]), {"above": 0.0}, LEVEL) is None
    none = intervals.maximum(np.zeros(9))
    least = intervals.needed(none, {"at_most": 0}, LEVEL)
    assert least == intervals.least(none, {"at_most": 0}, LEVEL) == MIN_TRIALS
    assert intervals.needed(none, {"at_most": 0}, LEVEL / 10) > MIN_TRIALS
    exact = intervals.mean(NORMAL)
    assert intervals.needed(exact, {"above": exact.value}, LEVEL) == MOST_NEEDED
    clear = intervals.mean(np.full(10, 5.0))
    assert intervals.needed(clear, {"above": 1.0}, LEVEL) == MIN_TRIALS
    ones = intervals.share(np.ones(6))
    assert intervals.needed(ones, {"at_least": 0.9}, LEVEL) == 53
    assert decided(intervals.share(np.ones(53)), {"at_least": 0.9}) == REPRODUCED
    assert decided(intervals.share(np.ones(52)), {"at_least": 0.9}) == OPEN


@pytest.mark.parametrize("level", [0.05, 0.05 / 40, 1e-12])
@pytest.mark.parametrize(
    ("estimate", "threshold"),
    [
        (intervals.mean, 0.0),
        (intervals.share, 0.9),
        (intervals.share, 0.2),
        (intervals.median, 0.0),
    ],
)
def test_the_least_number_is_that_of_trials_as_clear_as_possible(estimate, threshold, level):
    def p_value(n: int) -> float:
        clear = 1.0 + np.linspace(-1e-9, 1e-9, n) if estimate is intervals.mean else np.ones(n)
        return min(estimate(clear).tails(threshold, tie_below=False))

    least = intervals.least(estimate(np.ones(3)), {"above": threshold}, level)
    assert p_value(least) <= level
    assert least == MIN_TRIALS or p_value(least - 1) > level


def test_shares_that_hardly_vary_between_trials_need_fewer_of_them():
    values = np.tile([0.75, 0.85], 10)
    alike, varied = intervals.share(values), intervals.Share(0.8, 20)
    needed = [intervals.needed(each, {"above": 0.6}, LEVEL) for each in (alike, varied)]
    assert needed[0] < needed[1]


def test_values_without_spread_decide_only_if_most_instances_are_shown_to_agree():
    """Of a quantity that differs in 5 % of the instances, 20 equal values are no surprise."""
    assert decided(intervals.mean(np.zeros(20)), {"at_most": 0.0}, 0.01) == OPEN
    assert decided(intervals.mean(np.zeros(60)), {"at_most": 0.0}, 0.01) == REPRODUCED


def test_the_needed_number_of_a_median_does_not_count_ties():
    tied = intervals.median(np.repeat([-1.0, 0.0], [12, 18]))
    assert decided(tied, {"below": 0.0}) == OPEN
    assert intervals.needed(tied, {"below": 0.0}, LEVEL) == MOST_NEEDED
