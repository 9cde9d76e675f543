"""The ledger of claims: hypothetical tables bring every kind of check to each of its verdicts."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import report_fixture
from typer.testing import CliRunner

from baselines import registry
from reports.__main__ import app
from reports.ledger import intervals
from reports.ledger.evidence import Evidence, Experiment
from reports.ledger.finding import CHECKS, STUDY_CHECKS, Source, select
from reports.ledger.intervals import NOT, NOT_RUN, OPEN, REPRODUCED, Interval
from reports.ledger.judging import LEDGER, Claim, Ledger, judge_claim, ledger
from reports.tables import PENALTY, ReportError, Tables, counted_time
from workflows import records

TRIALS = 30
LEVELS = (0.0, 0.1, 0.2)
CARDS = {
    "ours": {"baseline": "dcreg", "options": {}, "limits": {"time_s": 10.0}},
    "half": {"baseline": "dcreg", "options": {}, "n_inliers_ratio": 0.5},
    "bound": {"baseline": "dcreg", "options": {"bound": "dc"}},
    "rival": {"baseline": "rpm_htb", "provenance": "reconstruction", "display_name": "RPM-HTB"},
}
ROLES = {"ours": "dcreg", "half": "dcreg_half", "bound": "dcreg_bound", "rival": "rpm_htb"}


def runs_of(method: str, **columns) -> pd.DataFrame:
    """Runs of one method on the grid; a column is a value, or a function of level and random draw."""
    rng = np.random.default_rng(sum(map(ord, method)))
    rows = []
    for level in LEVELS:
        for trial in range(TRIALS):
            row = {
                "run_id": f"{method}-{level}-{trial}", "instance_id": f"{level}-{trial}",
                "method": method, "display_name": method, "dataset": "d", "shape": "fish",
                "test": "noise", "level": level, "trial": trial, "model": "similarity2d",
                "experiment": "paper2d", "outcome": "finished", "status": "optimal",
                "success": True, "rmse_excess": 0.01, "T_reference": "[]", "time_solve_s": 1.0,
                "certificate_scope": "similarity pose", "verdict": "right", "n_nodes": 100.0,
                "objective": 1.0, "gap_tol": 0.1, "lower_bound": 0.95, "objective_best": 1.0,
                "bound_violation": 0.0, "rmse": 0.02, "regret_at_most": np.nan,
            }  # fmt: skip
            draw = 1 + 0.1 * rng.random()
            for name, value in columns.items():
                row[name] = value(level, draw) if callable(value) else value
            rows.append(row)
    return pd.DataFrame(rows)


def evidence(*tables: pd.DataFrame, traces: pd.DataFrame | None = None) -> Evidence:
    made = Tables(
        directory=Path("nowhere"),
        runs=pd.concat(tables, ignore_index=True),
        traces=pd.DataFrame(columns=list(records.TRACES)) if traces is None else traces,
        accounting=pd.DataFrame(),
        provenance={"methods": CARDS},
        overlays=[],
    )
    return Evidence({"paper2d": Experiment(made)}, {})


def judged(found: Evidence, *checks: dict, experiment: str = "paper2d", **fields):
    claim = Claim("c", "q", "t", experiment, checks, **fields)
    return judge_claim(ledger(), claim, found)


def figures(check: dict, *tables: pd.DataFrame, **given) -> list[tuple[float, int]]:
    """Figure and number of instances of every part of a check."""
    available = evidence(*tables, **given)
    found = CHECKS[check["kind"]](
        Source(available, available.experiments["paper2d"], ledger().roles), check
    )
    return [(part.interval.value, part.interval.n) for part in found.parts]


def trace(method: str, seconds: float) -> pd.DataFrame:
    """Bound histories that close at once after `seconds`."""
    return history(method, (0.0, 0.0), (seconds, 1.0))


def history(method: str, *steps: tuple[float, float]) -> pd.DataFrame:
    """Bound histories with these times and lower bounds."""
    rows = [
        {"run_id": run, "time_s": time, "lower_bound": low, "upper_bound": 1.0}
        for run in runs_of(method)["run_id"]
        for time, low in steps
    ]
    return pd.DataFrame(rows)


def error(value):
    return lambda level, draw: value * draw


RATIO = {"kind": "ratio", "subject": "dcreg", "rivals": ["rpm_htb"], "claimed": {"below": 1.0}}
VALUE = {"kind": "value", "methods": ["dcreg"], "claimed": {"below": 0.02}}
RISE = {"kind": "rise", "methods": ["rpm_htb"], "claimed": {"at_least": 3}}
SPREAD = {"kind": "spread", "methods": ["dcreg"], "claimed": {"below": 1.5}}
SLOPE = {"kind": "slope", "methods": ["dcreg"], "rivals": ["rpm_htb"], "claimed": {"below": 0}}
TREND = {"kind": "trend", "methods": ["dcreg"], "quantities": ["time"], "claimed": {"above": 0}}
RACE = {"kind": "race", "subject": "dcreg", "rivals": ["rpm_htb"], "claimed": {"below": 0.5}}
REGRET = {
    "kind": "regret", "subject": "dcreg_half", "reference": "dcreg", "claimed": {"at_least": 0.95},
}  # fmt: skip


def noisy(level, draw):
    return 0.001 + 0.1 * (draw - 1)


CASES = [
    (RATIO, [("ours", {}), ("rival", {"rmse_excess": error(0.1)})], REPRODUCED),
    (RATIO, [("ours", {"rmse_excess": error(0.1)}), ("rival", {})], NOT),
    (RATIO, [("ours", {}), ("rival", {})], NOT),  # a tie is not below
    (RATIO, [("ours", {"rmse_excess": error(0.01)}), ("rival", {"rmse_excess": error(0.01)})], OPEN),
    (VALUE, [("ours", {"rmse_excess": error(0.01)})], REPRODUCED),
    (VALUE, [("ours", {"rmse_excess": error(0.03)})], NOT),
    (VALUE, [("ours", {"rmse_excess": lambda level, draw: 0.4 * (draw - 1)})], OPEN),
    (RISE, [("rival", {"rmse_excess": lambda level, draw: draw * 10 ** (10 * level - 2)})], REPRODUCED),
    (RISE, [("rival", {"rmse_excess": error(0.1)})], NOT),
    (RISE, [("rival", {"rmse_excess": lambda level, draw: (0.01, 0.03)[level > 0.1] * draw**9})], OPEN),
    (SPREAD, [("ours", {"rmse_excess": error(0.1)})], REPRODUCED),
    (SPREAD, [("ours", {"rmse_excess": lambda level, draw: draw * (0.1 + level)})], NOT),
    (SPREAD, [("ours", {"rmse_excess": lambda level, draw: draw**9 * (0.02 + 0.05 * level)})], OPEN),
    (SLOPE, [("ours", {}), ("rival", {"rmse_excess": lambda level, draw: draw * level})], REPRODUCED),
    (SLOPE, [("ours", {"rmse_excess": lambda level, draw: draw * level}), ("rival", {})], NOT),
    (SLOPE, [("ours", {"rmse_excess": noisy}), ("rival", {"rmse_excess": noisy})], OPEN),
    (TREND, [("ours", {"time_solve_s": lambda level, draw: draw + 10 * level})], REPRODUCED),
    (TREND, [("ours", {"time_solve_s": lambda level, draw: draw - level})], NOT),
    (TREND, [("ours", {"time_solve_s": lambda level, draw: draw})], OPEN),
    (REGRET, [("ours", {}), ("half", {"objective": 1.05})], REPRODUCED),
    (REGRET, [("ours", {}), ("half", {"objective": 1.2})], NOT),
    (REGRET, [("ours", {}), ("half", {"objective": lambda level, draw: 2.0 if draw > 1.0997 else 1.05})],
     OPEN),
]  # fmt: skip


@pytest.mark.parametrize(("check", "methods", "verdict"), CASES)
def test_every_check_over_runs_can_say_all_three(check, methods, verdict):
    tables = [runs_of(name, **columns) for name, columns in methods]
    found = judged(evidence(*tables), check)
    assert found.verdict == verdict, found
    assert found.evidence
    assert found.reason


@pytest.mark.parametrize(
    ("mine", "theirs", "verdict"), [(0.1, 1.0, REPRODUCED), (1.0, 0.1, NOT), (0.5, 1.0, NOT)]
)
def test_race_compares_times_to_the_same_gap(mine, theirs, verdict):
    traces = pd.concat([trace("ours", mine), trace("rival", theirs)])
    found = judged(evidence(runs_of("ours"), runs_of("rival"), traces=traces), RACE)
    assert found.verdict == verdict
    assert f"{mine / theirs:.3g}" in found.evidence


STUDY = [
    ({"kind": "boxes", "subject": "dc", "rivals": ["termwise-r1"], "claimed": {"at_least": 0.9}},
     "boxes", lambda sign: pd.DataFrame([
         {"instance": "i", "place": "p", "draw": d, "width": 1.0, "bound": b, "value": v}
         for d in range(40)
         for b, v in (("dc", 1.0), ("termwise-r1", 1.0 - (sign if sign else d % 10 - 0.5)))
     ])),
    ({"kind": "orders", "bounds": {"dc": {"at_least": 1.8}}},
     "orders", lambda sign: pd.DataFrame({"bound": "dc", "order": 1.8 + 0.1 * (
         np.arange(8) % 4 - 1.5 if sign == 0 else sign * np.ones(8))})),
    ({"kind": "work", "subject": "dc", "rivals": ["interval"], "claimed": {"below": 1.0}},
     "searches", lambda sign: pd.DataFrame([
         {"instance": i, "bound": b, "n_assignments": n, "gap": g if n else 100.0}
         for i in range(8) for n in (0, 10)
         for b, g in (("dc", 2.0 - (sign if sign else i % 2 - 0.5)), ("interval", 2.0))
     ])),
]  # fmt: skip


@pytest.mark.parametrize(("check", "table", "make"), STUDY)
def test_every_check_over_the_study_can_say_all_three(check, table, make):
    for sign, verdict in ((1, REPRODUCED), (-1, NOT), (0, OPEN)):
        found = judged(Evidence({}, {table: make(sign)}), check, experiment="bounds")
        assert found.verdict == verdict, (sign, found)


@pytest.mark.parametrize(
    ("chosen", "levels", "trials"),
    [
        ({}, LEVELS, TRIALS),
        ({"levels": "top"}, [0.2], TRIALS),
        ({"levels": "bottom"}, [0.0], TRIALS),
        ({"levels": "disturbed"}, [0.1, 0.2], TRIALS),
        ({"levels": [0.0, 0.1]}, [0.0, 0.1], TRIALS),
        ({"tests": ["noise"], "where": {"trial": 3}}, LEVELS, 1),
        ({"tests": ["deformation"]}, [], 0),
    ],
)
def test_runs_are_chosen_by_test_level_and_column(chosen, levels, trials):
    runs = select(pd.concat([runs_of("ours"), runs_of("rival")]), "ours", chosen)
    assert list(runs["level"].unique()) == list(levels)
    assert len(runs) == len(levels) * trials


def test_checks_of_closed_searches_leave_the_others_out():
    late = runs_of("rival", rmse_excess=0.02)
    late.loc[late["trial"] < 10, ["status", "rmse_excess"]] = "time_limit", 0.5
    closed = {**RATIO, "closed": True, "by": []}
    assert figures(closed, runs_of("ours"), late) == [(pytest.approx(0.5), 60)]
    ours = runs_of("ours")
    ours.loc[ours["trial"] < 10, ["status", "objective"]] = "time_limit", 0.1
    assert figures(REGRET, ours, runs_of("half", objective=1.05)) == [(1.0, 60)]


def test_optima_below_the_tolerance_do_not_count_for_bounds():
    closed = {**RATIO, "closed": True, "by": []}
    trivial = runs_of("ours", objective=lambda level, draw: 0.1 if level else 1.0)
    assert figures(closed, trivial, runs_of("rival")) == [(pytest.approx(1.0), TRIALS)]
    found = judged(evidence(runs_of("ours", objective=0.1), runs_of("rival")), closed)
    assert found.verdict == NOT_RUN
    assert "instances that ours and rival certify" in found.reason


def test_spread_is_compared_with_that_of_rivals():
    two = runs_of("ours", rmse_excess=lambda level, draw: 0.1 + 0.5 * level)
    four = runs_of("rival", rmse_excess=lambda level, draw: 0.1 + 1.5 * level)
    check = {**SPREAD, "rivals": ["rpm_htb"], "claimed": {"below": 1}}
    assert figures(check, two, four) == [(pytest.approx(0.5), TRIALS)]


def test_levels_without_common_trials_are_compared_unpaired():
    alone = runs_of("ours", rmse_excess=lambda level, draw: 0.1 + level)
    check = {**SLOPE, "rivals": []}
    assert figures(check, alone) == [(pytest.approx(1.0), TRIALS)]
    assert figures({**check, "paired_levels": False}, alone) == [(pytest.approx(1.0), 90)]
    alone["shape"] = alone["instance_id"]
    assert figures(check, alone) == []


def test_race_ends_at_the_gap_that_both_reached():
    ours = history("ours", (0.0, 0.0), (1.0, 0.5), (5.0, 1.0))
    traces = pd.concat([ours, history("rival", (0.0, 0.0), (4.0, 0.5))])
    both = runs_of("ours"), runs_of("rival")
    assert figures(RACE, *both, traces=traces) == [(pytest.approx(0.25), 90)]


@pytest.mark.parametrize("ended", ["limited", "finished"])
@pytest.mark.parametrize(("seconds", "verdict"), [(1.0, REPRODUCED), (6.0, OPEN)])
def test_a_search_without_any_bound_is_no_tie_in_a_race(ended, seconds, verdict):
    """It took 10 s and might have needed longer; without any bound there is no gap to compare."""
    idle = trace("rival", 10.0).assign(lower_bound=0.0)
    traces = pd.concat([trace("ours", seconds), idle])
    found = judged(evidence(runs_of("ours"), runs_of("rival", outcome=ended), traces=traces), RACE)
    assert found.verdict == verdict
    assert f"{seconds / 10:.3g}" in found.evidence
    neither = pd.concat([trace("ours", seconds).assign(lower_bound=0.0), idle])
    found = judged(evidence(runs_of("ours"), runs_of("rival"), traces=neither), RACE)
    assert found.verdict == NOT_RUN
    assert "bound histories of rival" in found.reason


def test_boxes_can_be_of_some_instances_only():
    check, _, make = STUDY[0]
    parts = make(1).assign(instance="2D fish"), make(-1).assign(instance="3D horse")
    table = pd.concat(parts)
    found = Source(Evidence({}, {"boxes": table}), None, {})
    shares = [CHECKS["boxes"](found, check | {"instances": name}).parts[0] for name in ("2D", "3D")]
    assert [(part.interval.value, part.interval.n) for part in shares] == [(1.0, 40), (0.0, 40)]


def test_every_kind_of_check_is_tried_here():
    tried = {check["kind"] for check, *_ in (*CASES, *STUDY)} | {"race"}
    assert tried == set(CHECKS)
    assert {check["kind"] for check, *_ in STUDY} == STUDY_CHECKS


@pytest.mark.parametrize("check", [RATIO, VALUE, RISE, SPREAD, SLOPE, TREND, RACE, REGRET])
def test_without_the_method_a_claim_is_not_run(check):
    bystander = runs_of("bound")
    found = judged(evidence(bystander), check)
    assert found.verdict == NOT_RUN
    assert "not in the tables" in found.reason
    assert judged(Evidence({}, {}), check).verdict == NOT_RUN


def test_a_method_that_never_ran_is_not_in_the_tables():
    absent = runs_of("rival", outcome="unavailable", status="unavailable")
    found = judged(evidence(runs_of("ours"), absent), RATIO)
    reason = "not in the tables: RPM-HTB; make the tables with make paper-2d"
    assert (found.verdict, found.reason) == (NOT_RUN, reason)


def test_holding_against_some_rivals_only_is_inconclusive():
    check = {**RATIO, "rivals": ["rpm_htb", "rpm_pa"]}
    found = judged(evidence(runs_of("ours"), runs_of("rival", rmse_excess=0.1)), check)
    assert found.verdict == OPEN
    assert "RPM-PA" in found.reason


def test_holding_at_some_levels_only_is_inconclusive():
    ours = evidence(runs_of("ours", rmse_excess=error(0.01)))
    assert judged(ours, {**VALUE, "levels": [0.1, 0.2]}).verdict == REPRODUCED
    found = judged(ours, {**VALUE, "levels": [0.2, 0.3]})
    assert found.verdict == OPEN
    assert found.reason == "the available part agrees with the claim; not in the tables: level 0.3"
    found = judged(ours, {**VALUE, "tests": ["noise", "deformation"]})
    assert found.verdict == OPEN
    assert "deformation" in found.reason


def test_levels_beyond_the_axes_of_the_paper_count_only_where_they_are_listed():
    runs = runs_of("ours", rmse_excess=lambda level, draw: 0.5 if level > 0.1 else 0.01 * draw)
    runs = runs.assign(test="mixed_outliers", level=5 * runs["level"])  # 0, 0.5, 1
    assert judged(evidence(runs), VALUE).verdict == REPRODUCED
    top = {**VALUE, "levels": "top"}
    assert figures({**top, "levels": [1.0]}, runs) == [(0.5, TRIALS)]
    found = judged(evidence(runs), top)
    assert "mixed outliers, 0.5" in found.evidence


def test_the_only_level_of_a_test_is_not_its_bottom():
    alone = runs_of("ours").query("level == 0.2")
    check = {**VALUE, "levels": "bottom"}
    found = judged(evidence(alone), check)
    assert found.verdict == NOT_RUN
    assert "DC-Reg default in these tests and levels" in found.reason


def test_a_check_without_a_comparison_leaves_the_claim_open():
    ours = runs_of("ours", rmse_excess=error(0.01))
    found = judged(evidence(ours), VALUE, {**RISE, "methods": ["dcreg"], "levels": [0.1]})
    assert found.verdict == OPEN
    assert "error at the higher level" in found.reason


def limited(runs: pd.DataFrame, count: int, **columns) -> pd.DataFrame:
    """The runs, the first ones of each level as ended at a limit."""
    at_limit = runs["trial"] < count
    changed = runs.assign(outcome=runs["outcome"].mask(at_limit, "limited"))
    for name, value in columns.items():
        changed.loc[at_limit, name] = value
    return changed


def test_runs_at_a_limit_decide_where_no_end_of_theirs_could_turn_the_verdict():
    rival = runs_of("rival", rmse_excess=0.1)
    found = judged(evidence(runs_of("ours"), limited(rival, 5)), RATIO)
    assert (found.verdict, found.limited, found.runs) == (REPRODUCED, 15, 180)


def test_runs_at_a_limit_that_could_turn_the_verdict_leave_it_open_and_say_so():
    rival = limited(runs_of("rival", rmse_excess=0.1), TRIALS)
    found = judged(evidence(runs_of("ours"), rival), RATIO)
    assert (found.verdict, found.limited) == (OPEN, 90)
    assert "3 because of runs at a limit that could change them" in found.reason
    assert judged(evidence(runs_of("ours"), rival), RATIO, limits_decide=True).verdict == REPRODUCED


def test_a_run_at_a_limit_whose_answer_is_proven_optimal_counts_as_ended_but_for_its_time():
    rival = limited(runs_of("rival", rmse_excess=0.1), TRIALS, regret_at_most=0.05)
    found = judged(evidence(runs_of("ours"), rival), RATIO)
    assert (found.verdict, found.limited) == (REPRODUCED, 90)
    faster = {**RATIO, "quantity": "time", "claimed": {"above": 1.0}}
    slow = runs_of("ours", time_solve_s=1.5)
    assert judged(evidence(slow, runs_of("rival")), faster).verdict == REPRODUCED
    assert judged(evidence(slow, rival), faster).verdict == OPEN


@pytest.mark.parametrize(("side", "verdict"), [("above", REPRODUCED), ("below", NOT)])
def test_a_run_at_a_limit_took_at_least_its_time(side, verdict):
    slow = limited(runs_of("ours", time_solve_s=5.0), TRIALS)
    check = {**RATIO, "quantity": "time", "claimed": {side: 1.0}}
    assert judged(evidence(slow, runs_of("rival")), check).verdict == verdict


@pytest.mark.parametrize(
    "check",
    [{**RATIO, "claimed": {"within": [0.8, 1.25]}}, {**SLOPE, "claimed": {"within": [-0.1, 0.1]}}],
)
def test_a_range_between_the_ends_of_runs_at_a_limit_leaves_it_open(check):
    """Neither far too small nor far too large decides: the runs might have reached the claimed range."""
    mine = runs_of("ours", rmse_excess=lambda level, draw: draw * (0.01 + 2.0 * level))
    other = runs_of("rival", rmse_excess=0.01)
    assert judged(evidence(mine, other), check).verdict == NOT
    assert judged(evidence(limited(mine, TRIALS), other), check).verdict == OPEN


def test_a_run_at_a_limit_may_reach_the_maximum_rmse():
    check = {**VALUE, "quantity": "rmse", "claimed": {"below": 0.2}}
    mine = runs_of("ours", rmse=0.1)
    assert judged(evidence(mine, runs_of("rival", rmse=5.0)), check).verdict == REPRODUCED
    at_limit = limited(mine, TRIALS)
    assert judged(evidence(at_limit, runs_of("rival", rmse=5.0)), check).verdict == OPEN


@pytest.mark.parametrize("check", [SPREAD, {**TREND, "quantities": ["n_nodes"]}])
def test_figures_whose_extremes_are_not_known_stay_open_with_runs_at_a_limit(check):
    ours = runs_of("ours", n_nodes=lambda level, draw: draw + 10 * level)
    assert judged(evidence(ours), check).verdict == REPRODUCED
    assert judged(evidence(limited(ours, 1)), check).verdict == OPEN


@pytest.mark.parametrize(
    ("check", "level", "verdict"),
    [(RISE, 0.0, REPRODUCED), (RISE, 0.1, OPEN), (RISE, 0.2, OPEN),
     (SLOPE, 0.0, OPEN), (SLOPE, 0.1, REPRODUCED), (SLOPE, 0.2, OPEN)],
)  # fmt: skip
def test_runs_at_a_limit_turn_a_rise_by_the_level_they_are_at(check, level, verdict):
    """A rise is of the two highest levels; of three levels, the middle one moves no slope."""
    rises = runs_of("rival", rmse_excess=lambda at, draw: draw * (0.9 if at > 0.1 else 0.01))
    at_limit = rises["level"] == level
    rises["outcome"] = rises["outcome"].mask(at_limit, "limited")
    assert judged(evidence(runs_of("ours"), rises), check).verdict == verdict


def test_one_part_against_refutes_and_is_the_evidence():
    ours = runs_of("ours", rmse_excess=lambda level, draw: draw * (0.3 if level == 0.1 else 0.01))
    found = judged(evidence(ours, runs_of("rival", rmse_excess=error(0.1))), RATIO)
    assert found.verdict == NOT
    assert "noise, 0.1, the least favourable of 3" in found.evidence
    assert found.reason == "of 3 comparisons 2 as claimed, 1 against the claim"


@pytest.mark.parametrize(("least", "verdict"), [(0.1, REPRODUCED), (0.5, NOT)])
def test_one_part_is_enough_for_a_claim_with_any(least, verdict):
    ours = runs_of("ours", rmse_excess=lambda level, draw: draw * (least if level == 0.1 else 0.9))
    check = {**RATIO, "any": True}
    assert judged(evidence(ours, runs_of("rival", rmse_excess=0.2)), check).verdict == verdict


def test_one_wrong_certificate_refutes_that_there_are_none():
    (claim,) = (claim for claim in ledger().claims if claim.id == "eps-min")
    right = [runs_of(name) for name in ("ours", "half", "bound")]
    assert judge_claim(ledger(), claim, evidence(*right)).verdict == REPRODUCED
    for column in ("bound_violation", "lower_bound"):
        wrong = [right[0].copy(), *right[1:]]
        wrong[0].loc[7, [column, "status", "outcome"]] = 1.1, "time_limit", "limited"
        assert judge_claim(ledger(), claim, evidence(*wrong)).verdict == NOT


def test_a_verdict_names_the_reconstructions_that_it_relies_on():
    both = evidence(runs_of("ours"), runs_of("rival", rmse_excess=0.1))
    assert judged(both, RATIO).reconstruction == "RPM-HTB"
    assert judged(both, VALUE).reconstruction == ""


def test_few_instances_decide_nothing():
    few = (runs.query("trial < 4") for runs in (runs_of("ours"), runs_of("rival", rmse_excess=0.5)))
    found = judged(evidence(*few), RATIO)
    assert found.verdict == OPEN
    assert found.reason == "of 3 comparisons 3 inconclusive (3 with fewer than 5 instances)"


def test_instances_are_paired():
    ours = runs_of("ours", rmse_excess=error(0.01))
    rival = runs_of("rival", rmse_excess=error(0.1))
    unmatched = rival.assign(instance_id="other", rmse_excess=0.001)
    found = judged(evidence(ours, rival, unmatched), RATIO)
    assert found.verdict == REPRODUCED
    assert found.runs == 180


def test_no_pose_counts_as_a_longest_side_and_lengths_as_sides_of_the_source():
    pose = json.dumps([[0.0, -2.0, 5.0], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    runs = runs_of("ours", rmse_excess=0.1, T_reference=pose)
    runs.loc[0, "rmse_excess"] = np.nan
    errors = evidence(runs).experiments["paper2d"].runs["error"]
    assert errors.iloc[0] == 1.0
    np.testing.assert_allclose(errors.iloc[1:], 0.05)


def test_wrong_poses_search_errors_and_certificates_are_distinguished():
    runs = runs_of("ours")
    runs.loc[0, ["success", "verdict", "rmse"]] = False, "search_error", np.nan
    runs.loc[1, ["success", "verdict", "rmse"]] = False, "model_error", 3.0
    runs.loc[2, "certificate_scope"] = "translation in norm space"
    runs.loc[3, "status"] = "time_limit"
    known = evidence(runs).experiments["paper2d"].runs.head(5)
    assert list(known["wrong"]) == [True, True, False, False, False]
    assert list(known["search_error"]) == [1, 0, 0, 0, 0]
    assert list(known["certified"]) == [True, True, False, False, True]
    assert list(known["rmse"]) == [3.0, 3.0, 0.02, 0.02, 0.02]  # no pose: the worst of all


def test_times_of_unfinished_runs_count_as_twice_the_limit():
    runs = runs_of("ours", time_solve_s=3.0)
    runs.loc[0, "outcome"], runs.loc[1, ["outcome", "time_solve_s"]] = "limited", ["failed", np.nan]
    times = counted_time(runs, CARDS)
    assert list(times[:3]) == [PENALTY * 10, PENALTY * 10, 3.0]


def test_statistics_have_the_values_of_their_names():
    values = np.array([0.0, 1.0, 2.0, 3.0, 94.0])
    for name, value in (("mean", 20.0), ("median", 2.0), ("maximum", 94.0)):
        assert getattr(intervals, name)(values).value == value


def test_few_successes_do_not_show_a_share():
    claimed = {"at_least": 0.9}
    assert intervals.judge(intervals.share(np.ones(6)), claimed) == OPEN
    assert intervals.judge(intervals.share(np.ones(40)), claimed) == REPRODUCED
    assert intervals.judge(intervals.share(np.zeros(6)), claimed) == NOT
    check = {**VALUE, "quantity": "success", "by": [], "levels": [0.2], "claimed": claimed}
    few = runs_of("ours").query("trial < 6")
    assert judged(evidence(few), check).verdict == OPEN


def test_interval_has_its_nominal_coverage_of_the_mean():
    rng = np.random.default_rng(1)
    inside = [
        (found := intervals.mean(rng.normal(1.0, 1.0, 40))).low <= 1.0 <= found.high
        for _ in range(200)
    ]
    assert 0.88 <= np.mean(inside) <= 0.99


@pytest.mark.parametrize(
    ("claimed", "inside", "outside", "across"),
    [
        ({"below": 1}, (0.2, 0.9), (1.1, 2), (0.5, 1.5)),
        ({"above": 1}, (1.1, 2), (0.2, 0.9), (0.5, 1.5)),
        ({"at_most": 1}, (1, 1), (1.1, 2), (0.5, 1.5)),
        ({"at_least": 1}, (1, 1), (0.2, 0.9), (0.5, 1.5)),
        ({"within": [0.8, 1.25]}, (0.8, 1.25), (1.3, 2), (0.7, 1.0)),
    ],
)
def test_sides(claimed, inside, outside, across):
    def verdict(ends, n=10):
        return intervals.judge(Interval(sum(ends) / 2, *ends, n), claimed)

    assert verdict(inside) == REPRODUCED
    assert verdict(outside) == NOT
    assert verdict(across) == OPEN
    assert verdict(inside, n=4) == OPEN


# --- the ledger itself --------------------------------------------------------------------------


def test_ledger_holds_the_36_claims_with_command_and_check():
    book = ledger()
    assert len({claim.id for claim in book.claims}) == 36
    for claim in book.claims:
        assert claim.checks
        assert claim.quote
        assert claim.test
        assert claim.experiment in book.commands


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("kind: boxes", "kind: boxen", "no check 'boxen'"),
        ("subject: dcreg_half", "subject: dcreg_third", "no role 'dcreg_third'"),
        ("experiment: bounds", "experiment: bonds", "no command makes 'bonds'"),
    ],
)
def test_ledger_that_names_what_is_not_there_is_refused(tmp_path, old, new, message):
    path = tmp_path / "claims.yaml"
    path.write_text(LEDGER.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ReportError, match=re.escape(message)):
        Ledger.read(path)


def test_every_role_is_found_in_the_cards():
    named = {name for role in ledger().roles.values() for name in role.baseline}
    assert named <= set(registry.names())


def test_roles_prefer_the_plain_method_and_leave_out_oracles():
    roles = ledger().roles
    teaser = {"baseline": "teaser", "options": {"front_end": "oracle"}}
    assert roles["teaser"].fit(teaser) is None
    plain, tuned = (
        roles["teaser"].fit({"baseline": "teaser", "options": options})
        for options in ({}, {"threshold": "paper"})
    )
    assert plain < tuned
    assert roles["dcreg"].fit({"baseline": "dcreg", "options": {"bound": "dc"}}) is None
    assert roles["dcreg_half"].fit({"baseline": "dcreg", "n_inliers_ratio": 0.5, "options": {}})


@pytest.mark.parametrize(("role", "ratio"), [("dcreg_paper", 1.0), ("dcreg_half", 0.5)])
def test_claims_of_the_paper_are_about_its_own_bound_where_that_ran(role, ratio):
    card = {"baseline": "dcreg", "n_inliers_ratio": ratio}
    ours, published = (
        ledger().roles[role].fit({**card, "options": options}) for options in ({}, {"bound": "dc"})
    )
    assert published < ours


def test_only_claims_that_say_so_use_the_bounds_of_this_project():
    for claim in ledger().claims:
        roles = [check.get(key, []) for check in claim.checks for key in ("subject", "methods")]
        named = {role for names in roles for role in ([names] if isinstance(names, str) else names)}
        assert "dcreg" not in named or "this project's" in claim.test


def test_a_folder_of_another_name_is_noted(tmp_path):
    for folder in ("a-trial", "paper2d"):
        report_fixture.write_tables(tmp_path / folder / "tables", experiment="paper2d")
    (note,) = Evidence.of_folders([tmp_path]).notes
    assert f"those in {tmp_path / 'a-trial'}" in note
    (note,) = Evidence.of_folders([tmp_path / "a-trial"]).notes
    assert f"{tmp_path / 'a-trial'}, a folder of another name" in note


def test_command_judges_several_experiments_and_takes_the_whole_before_its_quick_part(tmp_path):
    for name in ("paper2d-quick", "paper2d", "other"):
        report_fixture.write_tables(tmp_path / name / "tables", experiment=name)
    study = tmp_path / "bounds"
    study.mkdir()
    for _, name, make in STUDY:
        make(1).to_csv(study / f"{name}.csv", index=False)
    found = Evidence.of_folders([tmp_path])
    assert set(found.experiments) == {"paper2d", "other"}
    assert found.experiments["paper2d"].tables.experiment == "paper2d"
    whole, quick = tmp_path / "paper2d", tmp_path / "paper2d-quick"
    assert found.notes == (f"paper2d: the tables in {whole} are used, not those in {quick}",)
    named = Evidence.of_folders([tmp_path / "paper2d-quick", tmp_path / "paper2d"])
    assert named.experiments["paper2d"].tables.experiment == "paper2d"
    of_quick = Evidence.of_folders([tmp_path / "paper2d-quick"])
    claim = next(claim for claim in ledger().claims if claim.id == "eps-min")
    judged_quick = judge_claim(ledger(), claim, of_quick)
    assert judged_quick.verdict != NOT_RUN
    assert judged_quick.command == "make paper-2d QUICK=1"
    of_tables = Evidence.of_tables(found.experiments["paper2d"].tables)
    assert set(of_tables.study) == {name for _, name, _ in STUDY}
    out = tmp_path / "out"
    answer = CliRunner().invoke(app, ["claims", str(tmp_path), "--out", str(out)])
    assert answer.exit_code == 0, answer.output
    table = pd.read_csv(out / "claims.csv")
    assert len(table) == 36
    verdicts = table.set_index("id")["verdict"]
    assert verdicts["tighter-bnb"] in (REPRODUCED, OPEN)
    assert verdicts["low-3d"] == NOT_RUN
    for row in table[table["verdict"] == NOT_RUN].itertuples():
        assert row.reason.endswith(f"with {row.command}")
        assert row.command.startswith("make ")
    assert table[["command", "reason"]].notna().all(axis=None)
    assert table.loc[table["verdict"] != NOT_RUN, "evidence"].notna().all()
    page = (out / "index.html").read_text(encoding="utf-8")
    found = re.search(r"Available tables: (\w+), (\w+), bounds\.", page)
    assert set(found.groups()) == {"paper2d", "other"}
    assert all(identity in page for identity in table["id"])


def test_a_folder_that_is_not_there_is_named(tmp_path):
    answer = CliRunner().invoke(app, ["claims", str(tmp_path / "nosuch"), "--out", str(tmp_path)])
    assert answer.exit_code == 2
    assert "nosuch: no such folder" in answer.output


def test_a_study_of_an_earlier_version_is_refused_with_its_command(tmp_path):
    for _, name, make in STUDY:
        make(1).replace({"bound": {"dc": "paper"}}).to_csv(tmp_path / f"{name}.csv", index=False)
    answer = CliRunner().invoke(app, ["claims", str(tmp_path), "--out", str(tmp_path)])
    assert answer.exit_code == 2
    assert "make them again with `make bounds`" in answer.output
