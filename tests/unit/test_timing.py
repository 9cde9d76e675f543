"""Paired times: planted differences are found in noise, and noise alone is not a difference."""

from contextlib import nullcontext

import numpy as np
import pandas as pd
import pytest

from tests.bench import interleaved, planted
from tests.bench.interleaved import COUNTED, MINIMUM_OF, REPETITIONS, TIMED
from workflows.timing import (
    COUNTERS,
    FEWEST,
    hodges_lehmann,
    is_precise,
    judge,
    judge_statuses,
    judge_work,
)


def times(rng: np.random.Generator, factor: float) -> pd.DataFrame:
    """Two problems, solved by both sides in turn while the load of the machine drifts.

    One solve in ten is disturbed: it takes up to twice as long.
    """
    rows = []
    for repetition in range(REPETITIONS):
        load = 1 + 0.5 * rng.random()
        for problem, seconds in (("a", 0.03), ("b", 0.05)):
            noise = rng.uniform(1.0, 1.1, (MINIMUM_OF, 2))
            disturbed = 1 + (rng.random((MINIMUM_OF, 2)) < 0.1) * rng.random((MINIMUM_OF, 2))
            base, head = seconds * load * (noise * disturbed).min(axis=0)
            rows.append(["rigid3d", problem, repetition, base, factor * head])
    return pd.DataFrame(
        rows, columns=["group", "problem", "repetition", "cpu_s_base", "cpu_s_head"]
    )


def found(factor: float, seed: int) -> str:
    (timed,) = judge(times(np.random.default_rng(seed), factor))
    return timed.verdict


def test_a_slow_down_is_found_in_19_of_20_trials_and_noise_gives_at_most_one_alarm():
    slower = [found(1.2, seed) for seed in range(20)]
    unchanged = [found(1.0, 100 + seed) for seed in range(20)]
    assert slower.count("slower") >= 19
    assert unchanged.count("slower") <= 1
    assert "faster" in {found(0.8, seed) for seed in range(3)}


def test_the_interval_is_that_of_the_signed_rank_test():
    logs = np.log([1.1, 1.2, 1.3, 1.4, 1.5, 1.8])
    ratio = hodges_lehmann(logs)
    assert ratio.low == pytest.approx(1.1)  # two-sided p is 2 / 2^6 < 0.05 < 4 / 2^6: the extremes
    assert ratio.high == pytest.approx(1.8)
    assert hodges_lehmann(logs[: FEWEST - 1]).verdict(1.05) == "unclear"


def test_the_interval_of_many_pairs_covers_the_truth_and_shrinks():
    draws = np.random.default_rng(0).normal(0.1, 0.1, (200, 60))
    ratios = [hodges_lehmann(row) for row in draws]
    covered = np.mean([ratio.low <= np.exp(0.1) <= ratio.high for ratio in ratios])
    assert 0.9 <= covered <= 0.99
    assert ratios[0].high / ratios[0].low < 1.12


def test_more_repetitions_are_wanted_until_the_interval_is_narrow():
    table = times(np.random.default_rng(0), 1.0)
    assert not is_precise(table[table["repetition"] < FEWEST - 1])
    noisy = table.assign(
        cpu_s_head=table["cpu_s_head"] * np.where(table["repetition"] % 2, 1.0, 1.3)
    )
    assert not is_precise(noisy)
    assert is_precise(table.assign(cpu_s_head=table["cpu_s_base"]))
    assert is_precise(table.iloc[:0])  # nothing is timed


def counted(**changes):
    """Return a table of two problems with two repetitions each, with some values changed."""
    table = pd.DataFrame({"problem": ["a", "b"] * 2, "repetition": [0, 0, 1, 1]})
    for side in ("base", "head"):
        table = table.assign(**{f"status_{side}": "optimal"})
        table = table.assign(**{f"{name}_{side}": [10, 20] * 2 for name in COUNTERS})
    for column, (row, value) in changes.items():
        table.loc[row, column] = value
    return table


@pytest.mark.parametrize(
    ("changes", "verdict", "detail"),
    [
        ({}, "same", ""),
        ({"n_nodes_head": ([1, 3], 21)}, "worse", "1 problems differ"),
        ({"n_nodes_head": ([1, 3], 19)}, "better", "1 problems differ"),
        ({"n_nodes_head": (3, 21)}, "worse", "between repetitions of the head"),
        ({"n_nodes_head": (3, 19)}, "worse", "between repetitions of the head"),
        ({"n_nodes_base": (3, 19)}, "changed", "between repetitions of the base"),
    ],
)
def test_work_must_repeat_exactly(changes, verdict, detail):
    nodes, assignments = judge_work(counted(**changes))
    assert nodes.verdict == verdict
    assert detail in nodes.detail
    assert assignments.verdict == "same"


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, "same"),
        ({"status_head": (3, "node_limit")}, "worse"),
        ({"status_base": (3, "node_limit")}, "changed"),
        ({"status_base": (3, "node_limit"), "status_head": (3, "time_limit")}, "worse"),
        ({"status_base": (3, "time_limit"), "status_head": (3, "time_limit")}, "same"),
    ],
)
def test_a_proof_that_is_lost_is_worse(changes, verdict):
    assert judge_statuses(counted(**changes)).verdict == verdict


def test_sides_take_turns_and_the_minimum_of_their_solves_is_kept(tmp_path, monkeypatch):
    asked = []

    class FakeSide:
        def __init__(self, name):
            self.name, self.count = name, 0

        def solve(self, problem):
            asked.append((problem, self.name))
            self.count += 1
            seconds = 1.0 + self.count % MINIMUM_OF + (self.name == "head")
            return {"cpu_s": seconds, "status": "optimal", "n_nodes": 5, "n_assignments": 7}

    monkeypatch.setattr(interleaved, "side", lambda path, file: nullcontext(FakeSide(path.name)))
    table = interleaved.measure(tmp_path / "base", {"head": tmp_path / "head"}, 6)["head"]
    counted, timed = table.iloc[: len(COUNTED)], table.iloc[len(COUNTED) :]
    assert counted["cpu_s_base"].isna().all()
    assert timed.groupby("problem")["repetition"].apply(list).tolist() == [[*range(6)]] * len(TIMED)
    assert set(timed["cpu_s_base"]) == {1.0}
    assert set(timed["cpu_s_head"]) == {2.0}
    first = [name for _, name in asked[::2]]
    assert first.count("base") == pytest.approx(len(first) / 2, abs=2)
    assert all(one[0] == other[0] for one, other in zip(asked[::2], asked[1::2], strict=True))
    assert all(one[1] != other[1] for one, other in zip(asked[::2], asked[1::2], strict=True))


def test_default_modes_are_timed_in_groups_of_their_own():
    """A slow-down of one mode must not disappear in the mean over others."""
    models = {}
    for problem, (given, options) in zip(TIMED, interleaved.problems(TIMED), strict=True):
        row = interleaved._row(problem, given["model"], 0)
        models.setdefault(row["group"], []).append(given["model"])
        assert row["group"].endswith("default mode") == (options["mode"] is None)
        if options["mode"] is None:
            assert "bound" not in options
            # without a limit on boxes, stages of mode full share the time
            assert given["model"] == "similarity2d" or "node_limit" in given
    assert models == {
        "similarity2d": ["similarity2d"] * 2, "rigid3d": ["rigid3d"],
        "similarity2d, default mode": ["similarity2d"] * 2,
        "rigid3d, default mode": ["rigid3d"] * 2,
    }  # fmt: skip


def test_planted_changes_fit_the_sources(tmp_path):
    for name, change in planted.CHANGES.items():
        if change is not None:
            source = (planted.ROOT / change.file).read_text(encoding="utf-8")
            assert source.count(change.old) == 1, name
            compile(source.replace(change.old, change.new), change.file, "exec")
