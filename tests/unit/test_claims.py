"""The ledger of claims: made-up tables bring every claim and every kind of check to its verdicts."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import claim_tables
import numpy as np
import pandas as pd
import pytest
import report_fixture
from typer.testing import CliRunner

from baselines import registry
from reports.__main__ import app
from reports.claims import PAGE
from reports.ledger.book import LEDGER, Claim, Ledger, ledger, roles_of
from reports.ledger.evidence import Evidence, Experiment
from reports.ledger.finding import CHECKS, STUDY_CHECKS, Source, select
from reports.ledger.intervals import MIN_INSTANCES, NOT, NOT_RUN, OPEN, REPRODUCED
from reports.ledger.judging import APART, count, judge, judge_claim
from reports.tables import ReportError, Tables
from workflows import records
from workflows.config import load
from workflows.stages.plan import expand, plan_table

TRIALS = 30
LEVELS = (0.0, 0.1, 0.2)
PAPER = json.dumps(claim_tables.options_of(ledger().roles["dcreg_paper"]))
HTB = json.dumps(claim_tables.options_of(ledger().roles["rpm_htb"]))
PA = json.dumps(claim_tables.options_of(ledger().roles["rpm_pa"]))
# Method -> role, baseline, effective options and n_p.
METHODS = {
    "paper": ("dcreg_paper", "dcreg_paper", PAPER, 1.0),
    "half": ("dcreg_paper_half", "dcreg_paper", PAPER, 0.5),
    "ours": ("dcreg", "dcreg", '{"bound": null, "mode": null, "front_end": null}', 1.0),
    "rival": ("rpm_htb", "rpm_htb", HTB, 1.0),
    "pa": ("rpm_pa", "rpm_pa", PA, 1.0),
}
CARDS = {
    "paper": {"limits": {"time_s": 10.0}, "language": "Python"},
    "rival": {
        "provenance": "reconstruction",
        "display_name": "RPM-HTB",
        "limits": {"time_s": 10.0},
    },
}
JUDGED = [claim for claim in ledger().claims if not claim.apart]


def runs_of(method: str, **columns) -> pd.DataFrame:
    """Runs of one method on the grid; a column is a value, or a function of level and random draw."""
    rng = np.random.default_rng(sum(map(ord, method)))
    _, baseline, options, ratio = METHODS[method]
    rows = []
    for level in LEVELS:
        for trial in range(TRIALS):
            row = {
                "run_id": f"{method}-{level}-{trial}", "instance_id": f"{level}-{trial}",
                "method": method, "display_name": method, "dataset": "d", "shape": "fish",
                "baseline": baseline, "options_effective": options, "n_inliers_ratio": ratio,
                "test": "noise", "level": level, "trial": trial, "model": "similarity2d",
                "experiment": "paper2d", "outcome": "finished", "status": "optimal",
                "success": True, "rmse": 0.05, "rmse_floor": 0.049, "rmse_excess": 0.01,
                "T_reference": "[]", "time_solve_s": 1.0, "n_source": 98, "n_target": 98,
                "certificate_scope": "similarity pose", "verdict": "right", "n_nodes": 100.0,
                "n_assignments": 1600.0, "objective": 1.0, "gap_tol": 0.1, "gap": 0.05,
                "lower_bound": 0.95, "upper_bound": 1.0, "objective_best": 1.0,
                "bound_violation": 0.0, "machine_id": "m",
            }  # fmt: skip
            draw = 1 + 0.1 * rng.random()
            for name, value in columns.items():
                row[name] = value(level, draw) if callable(value) else value
            rows.append(row)
    return pd.DataFrame(rows)


def evidence(*tables: pd.DataFrame, traces: pd.DataFrame | None = None, name="paper2d") -> Evidence:
    made = Tables(
        directory=Path("nowhere"),
        runs=pd.concat(tables, ignore_index=True).assign(experiment=name),
        traces=pd.DataFrame(columns=list(records.TRACES)) if traces is None else traces,
        accounting=pd.DataFrame(),
        provenance={"methods": CARDS, "machine": {"cpu": "a processor"}},
        overlays=[],
    )
    return Evidence({"paper2d": Experiment(made)}, {})


def judged(found: Evidence, *checks: dict, experiment: str = "paper2d", **fields):
    claim = Claim("c", "q", "t", experiment, checks, **fields)
    return judge_claim(ledger(), claim, found)


def figures(check: dict, *tables: pd.DataFrame, **given) -> list[tuple[float, int]]:
    """Figure and number of instances of every comparison of a check."""
    available = evidence(*tables, **given)
    found = CHECKS[check["kind"]](
        Source(available, available.experiments["paper2d"], ledger().roles), check
    )
    return [(part.estimate.value, part.estimate.n) for part in found.parts]


def history(method: str, *steps: tuple[float, float]) -> pd.DataFrame:
    """Bound histories with these times and lower bounds."""
    return pd.DataFrame(
        [
            {
                "run_id": run,
                "time_s": time,
                "n_assignments": 10 * time,
                "lower_bound": low,
                "upper_bound": 1.0,
            }
            for run in runs_of(method)["run_id"]
            for time, low in steps
        ]
    )


def limited(runs: pd.DataFrame, count: int, **columns) -> pd.DataFrame:
    """The runs, the first ones of each level as ended at a limit."""
    at_limit = runs["trial"] < count
    changed = runs.assign(outcome=runs["outcome"].mask(at_limit, "limited"))
    for name, value in columns.items():
        changed.loc[at_limit, name] = value
    return changed


def error(value):
    return lambda level, draw: value * draw


RATIO = {
    "kind": "ratio",
    "subject": "dcreg_paper",
    "rivals": ["rpm_htb"],
    "claimed": {"below": 1.0},
}
TIME = {**RATIO, "quantity": "time"}
VALUE = {"kind": "value", "methods": ["dcreg_paper"], "claimed": {"below": 0.06}}
LOW = {"kind": "low", "methods": ["dcreg_paper"], "claimed": {"at_most": 1}}
RISE = {"kind": "rise", "methods": ["rpm_htb"], "claimed": {"at_least": 3}}
SCATTER = {**RATIO, "kind": "scatter"}
SLOPE = {
    "kind": "slope",
    "methods": ["dcreg_paper"],
    "rivals": ["rpm_htb"],
    "claimed": {"below": 0},
}
TREND = {
    "kind": "trend",
    "methods": ["dcreg_paper"],
    "quantities": ["time"],
    "claimed": {"above": 0},
}
RACE = {**RATIO, "kind": "race", "quantity": "time", "claimed": {"below": 0.5}}
REGRET = {
    "kind": "regret", "subject": "dcreg_paper", "reference": "dcreg", "claimed": {"at_least": 0.9},
}  # fmt: skip
SENSITIVITY = {
    "kind": "sensitivity", "subject": ["dcreg_paper_half", "dcreg_paper"],
    "rival": ["rpm_pa", "rpm_htb"], "quantities": ["n_nodes"], "claimed": {"below": 0.5},
}  # fmt: skip


def noisy(level, draw):
    return 0.001 + 0.1 * (draw - 1)


def spread_over(width):
    return lambda level, draw: 0.05 + width * (draw - 1.05)


# --- every claim --------------------------------------------------------------------------------


@pytest.mark.parametrize("claim", JUDGED, ids=lambda claim: claim.id)
@pytest.mark.parametrize("true", [True, False], ids=["oracle", "adversary"])
def test_every_claim_can_be_reproduced_and_can_fail(claim, true, tmp_path):
    """A true table that cannot pass is a wrong check, as is a reversed one that cannot fail."""
    claim_tables.write(ledger(), claim, tmp_path, true=true)
    found = judge_claim(ledger(), claim, Evidence.of_folders([tmp_path]))
    assert found.verdict == (REPRODUCED if true else NOT), (found.reason, found.evidence)
    assert found.rows
    assert len(found.data)
    assert found.tested.startswith("Tested: ")


def test_claims_without_oracle_stand_apart_with_a_reason():
    apart = [claim for claim in ledger().claims if claim.apart]
    assert len(ledger().claims) == 37
    assert len(apart) <= 4
    for claim in apart:
        assert claim.because
        assert all(entry["beside"] for entry in claim.checks)


@pytest.mark.parametrize("claim", JUDGED, ids=lambda claim: claim.id)
def test_no_quick_part_refutes_a_claim_by_few_instances_or_by_a_limit(claim, tmp_path):
    if claim.experiment == "bounds":
        pytest.skip("has no quick part")
    few = claim_tables.write(ledger(), claim, tmp_path / "few", true=False, trials=3, quick=True)
    found = judge_claim(ledger(), claim, Evidence.of_folders([few]))
    decided = [row for row in found.rows if row.verdict != OPEN]
    assert all(each.part.estimate.n >= MIN_INSTANCES for row in decided for each in row.decided)
    many = claim_tables.write(ledger(), claim, tmp_path / "many", true=False, trials=30, quick=True)
    path = many / "tables" / "runs.parquet"
    runs = pd.read_parquet(path)
    pd.DataFrame(runs.assign(outcome="limited", status="time_limit")).to_parquet(path)
    counted = pd.read_csv(many / "tables" / "accounting.csv")
    counted.assign(limited=counted["planned"], finished=0, failed=0).to_csv(
        many / "tables" / "accounting.csv", index=False
    )
    found = judge_claim(ledger(), claim, Evidence.of_folders([many]))
    assert found.verdict in (OPEN, NOT_RUN)
    assert all(row.verdict == OPEN for row in found.rows)
    if found.verdict == OPEN:
        assert "hit a limit" in found.reason
        assert any("full experiment" in row.instances for row in found.rows)


# --- every kind of check ------------------------------------------------------------------------

CASES = [
    (RATIO, [("paper", {}), ("rival", {"rmse": error(0.1)})], REPRODUCED),
    (RATIO, [("paper", {"rmse": error(0.1)}), ("rival", {})], NOT),
    (RATIO, [("paper", {}), ("rival", {})], NOT),  # a tie is not below
    (RATIO, [("paper", {"rmse": error(0.05)}), ("rival", {"rmse": error(0.05)})], OPEN),
    (VALUE, [("paper", {"rmse": error(0.05)})], REPRODUCED),
    (VALUE, [("paper", {"rmse": error(0.07)})], NOT),
    (VALUE, [("paper", {"rmse": lambda level, draw: 1.2 * (draw - 1)})], OPEN),
    (LOW, [("paper", {"rmse": error(0.05)})], REPRODUCED),
    (LOW, [("paper", {"rmse": 0.3, "rmse_excess": 0.01})], REPRODUCED),
    (LOW, [("paper", {"rmse": 0.07, "rmse_excess": 0.05})], NOT),
    (LOW, [("paper", {"rmse": 0.3, "rmse_excess": lambda level, draw: 0.4 * (draw - 1)})], OPEN),
    (RISE, [("rival", {"rmse": lambda level, draw: draw * 10 ** (10 * level - 2)})], REPRODUCED),
    (RISE, [("rival", {"rmse": error(0.1)})], NOT),
    (RISE, [("rival", {"rmse": lambda level, draw: (0.01, 0.03)[level > 0.1] * draw**9})], OPEN),
    (SCATTER, [("paper", {"rmse": spread_over(0.1)}), ("rival", {"rmse": spread_over(0.5)})], REPRODUCED),
    (SCATTER, [("paper", {"rmse": spread_over(0.5)}), ("rival", {"rmse": spread_over(0.1)})], NOT),
    (SCATTER, [("paper", {"rmse": spread_over(0.1)}), ("rival", {"rmse": spread_over(0.1)})], OPEN),
    (SLOPE, [("paper", {}), ("rival", {"rmse": lambda level, draw: draw * level})], REPRODUCED),
    (SLOPE, [("paper", {"rmse": lambda level, draw: draw * level}), ("rival", {})], NOT),
    (SLOPE, [("paper", {"rmse": noisy}), ("rival", {"rmse": noisy})], OPEN),
    (TREND, [("paper", {"time_solve_s": lambda level, draw: draw + 10 * level})], REPRODUCED),
    (TREND, [("paper", {"time_solve_s": lambda level, draw: draw - level})], NOT),
    (TREND, [("paper", {"time_solve_s": lambda level, draw: draw})], OPEN),
    (REGRET, [("ours", {}), ("paper", {"objective": 1.05})], REPRODUCED),
    (REGRET, [("ours", {}), ("paper", {"objective": 1.2})], NOT),
    (REGRET, [("ours", {}), ("paper", {"objective": lambda level, draw: 2.0 if draw > 1.09 else 1.05})],
     OPEN),
    (SENSITIVITY, [("half", {}), ("paper", {}), ("pa", {"n_nodes": 500.0}), ("rival", {})], REPRODUCED),
    (SENSITIVITY, [("half", {"n_nodes": 20.0}), ("paper", {}), ("pa", {}), ("rival", {})], NOT),
    (SENSITIVITY, [("half", {}), ("paper", {}), ("pa", {"n_nodes": lambda level, draw: 100 * draw**13}),
                   ("rival", {})], OPEN),
]  # fmt: skip


@pytest.mark.parametrize(("check", "methods", "verdict"), CASES)
def test_every_check_over_runs_can_say_all_three(check, methods, verdict):
    tables = [runs_of(name, **columns) for name, columns in methods]
    found = judged(evidence(*tables), check)
    assert found.verdict == verdict, (found.reason, found.evidence)
    assert found.evidence
    assert found.reason


@pytest.mark.parametrize(
    ("mine", "theirs", "verdict"), [(0.1, 1.0, REPRODUCED), (1.0, 0.1, NOT), (0.5, 1.0, NOT)]
)
def test_race_compares_times_to_the_same_gap(mine, theirs, verdict):
    ends = [history(m, (0.0, 0.0), (s, 1.0)) for m, s in (("paper", mine), ("rival", theirs))]
    found = judged(evidence(runs_of("paper"), runs_of("rival"), traces=pd.concat(ends)), RACE)
    assert found.verdict == verdict
    assert f"{mine / theirs:.3g}" in found.evidence
    assert found.rows[0].second_title == "assignments"
    assert found.rows[0].second_value.startswith(f"{mine / theirs:.3g}")


def _boxes(sign: int) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {"instance": "i", "place": "p", "draw": d, "width": 1.0, "bound": b, "value": v}
            for d in range(100)
            for b, v in (("dc", 2.0), ("termwise-r1", 2.0 - (sign if sign else d % 10 - 0.5)))
        ]
    )


def _orders(sign: int) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "instance": "i", "place": "holding", "draw": draw, "width": width, "bound": "dc",
                "minimum": 1.0, "n_assignments": 1,
                "value": 1.0 - width ** (1.8 + 0.1 * (sign or draw % 4 - 1.5)),
            }
            for draw in range(40)
            for width in (0.1, 0.2, 0.4)
        ]
    )  # fmt: skip


def _searches(sign: int) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {"instance": i, "bound": b, "n_assignments": n, "gap": g if n else 100.0}
            for i in range(24)
            for n in (0, 10)
            for b, g in (("dc", 2.0 - (sign if sign else i % 2 - 0.5)), ("interval", 2.0))
        ]
    )


STUDY = [
    ({"kind": "boxes", "subject": "dc", "rivals": ["termwise-r1"], "claimed": {"at_least": 0.9}},
     "boxes", _boxes),
    ({"kind": "orders", "bounds": {"dc": {"at_least": 1.8}}}, "boxes", _orders),
    ({"kind": "work", "subject": "dc", "rivals": ["interval"], "claimed": {"below": 1.0}},
     "searches", _searches),
]  # fmt: skip


@pytest.mark.parametrize(("check", "table", "make"), STUDY)
def test_every_check_over_the_study_can_say_all_three(check, table, make):
    for sign, verdict in ((1, REPRODUCED), (-1, NOT), (0, OPEN)):
        found = judged(Evidence({}, {table: make(sign)}), check, experiment="bounds")
        assert found.verdict == verdict, (sign, found.evidence)


def test_every_kind_of_check_is_tried_here():
    tried = {check["kind"] for check, *_ in (*CASES, *STUDY)} | {"race"}
    assert tried == set(CHECKS)
    assert {check["kind"] for check, *_ in STUDY} == STUDY_CHECKS


def test_boxes_count_values_below_zero_as_zero_and_can_be_of_some_instances_only():
    check, _, make = STUDY[0]
    table = pd.concat([make(1).assign(instance="2D fish"), make(-1).assign(instance="3D horse")])
    for shift, shares in ((0.0, [(1.0, 100), (0.0, 100)]), (-9.0, [(1.0, 100), (1.0, 100)])):
        shifted = {"boxes": table.assign(value=table["value"] + shift)}
        source = Source(Evidence({}, shifted), None, {})
        parts = [CHECKS["boxes"](source, check | {"instances": d}).parts[0] for d in ("2D", "3D")]
        assert [(part.estimate.value, part.estimate.n) for part in parts] == shares


def test_the_centre_has_the_least_maximum_error_over_the_vertices():
    """The proof of claim `centre`, on random boxes and maps."""
    rng = np.random.default_rng(7)
    for _ in range(200):
        dim = int(rng.integers(2, 5))
        centre, half, J = rng.normal(size=dim), rng.random(dim), rng.normal(size=(dim + 1, dim))
        signs = np.array(np.meshgrid(*[[-1, 1]] * dim)).reshape(dim, -1).T
        vertices = centre + signs * half

        def worst(at, vertices=vertices, J=J):
            return (((vertices - at) @ J.T) ** 2).sum(axis=1).max()

        others = centre + rng.uniform(-1, 1, (50, dim)) * half
        assert worst(centre) <= min(map(worst, others)) + 1e-12


# --- choice and values of runs ------------------------------------------------------------------


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
    runs = select(pd.concat([runs_of("paper"), runs_of("rival")]), "paper", chosen)
    assert list(runs["level"].unique()) == list(levels)
    assert len(runs) == len(levels) * trials


def test_checks_of_closed_searches_leave_the_others_out():
    late = runs_of("rival", rmse=0.1)
    late.loc[late["trial"] < 10, ["status", "rmse"]] = "time_limit", 0.5
    closed = {**RATIO, "closed": True, "by": []}
    assert figures(closed, runs_of("paper"), late) == [(pytest.approx(0.5), 60)]
    ours = runs_of("ours")
    ours.loc[ours["trial"] < 10, ["status", "objective"]] = "time_limit", 0.1
    of_all = {**REGRET, "by": ["model"]}
    assert figures(of_all, ours, runs_of("paper", objective=1.05)) == [(1.0, 60)]


def test_optima_below_the_tolerance_do_not_count_for_bounds():
    closed = {**RATIO, "closed": True, "by": []}
    trivial = runs_of("paper", objective=lambda level, draw: 0.1 if level else 1.0)
    assert figures(closed, trivial, runs_of("rival")) == [(pytest.approx(1.0), TRIALS)]
    found = judged(evidence(runs_of("paper", objective=0.1), runs_of("rival")), closed)
    assert found.verdict == NOT_RUN
    assert "instances that paper and rival certify" in found.reason


def test_levels_without_common_trials_are_compared_unpaired():
    alone = runs_of("paper", rmse=lambda level, draw: 0.1 + level)
    check = {**SLOPE, "rivals": []}
    assert figures(check, alone) == [(pytest.approx(1.0), TRIALS)]
    assert figures({**check, "paired_levels": False}, alone) == [(pytest.approx(1.0), 90)]
    alone["shape"] = alone["instance_id"]
    assert figures(check, alone) == []


def test_race_ends_at_the_gap_that_both_reached():
    ours = history("paper", (0.0, 0.0), (1.0, 0.5), (5.0, 1.0))
    traces = pd.concat([ours, history("rival", (0.0, 0.0), (4.0, 0.5))])
    both = runs_of("paper"), runs_of("rival")
    assert figures(RACE, *both, traces=traces) == [(pytest.approx(0.25), 90)]


@pytest.mark.parametrize(("seconds", "verdict"), [(1.0, REPRODUCED), (6.0, OPEN)])
def test_a_search_without_any_bound_is_no_tie_in_a_race(seconds, verdict):
    """It took 10 s and might have needed longer; without any bound there is no gap to compare."""
    idle = history("rival", (0.0, 0.0), (10.0, 0.0))
    traces = pd.concat([history("paper", (0.0, -3.0), (seconds, 1.0)), idle])
    found = judged(evidence(runs_of("paper"), runs_of("rival"), traces=traces), RACE)
    assert found.verdict == verdict
    assert f"{seconds / 10:.3g}" in found.evidence
    neither = pd.concat([history("paper", (seconds, -1.0)), idle])
    found = judged(evidence(runs_of("paper"), runs_of("rival"), traces=neither), RACE)
    assert found.verdict == NOT_RUN
    assert "bound histories of rival" in found.reason


def test_a_cost_that_doubles_is_as_sensitive_as_one_that_halves():
    tables = [("half", 50.0), ("paper", 100.0), ("pa", 400.0), ("rival", 100.0)]
    runs = [runs_of(name, n_nodes=value) for name, value in tables]
    assert figures(SENSITIVITY, *runs) == [(pytest.approx(0.5), 90)]
    assert judged(evidence(*runs[:3], limited(runs[3], 1)), SENSITIVITY).verdict == OPEN


def test_the_raw_error_is_judged_and_the_error_above_the_floor_stands_beside():
    """A difference of 2 % of the raw RMSE is a factor of 3 above the floor."""
    ours = runs_of("paper", rmse=0.051, rmse_excess=0.03)
    rival = runs_of("rival", rmse=0.050, rmse_excess=0.01)
    found = judged(evidence(ours, rival), {**RATIO, "claimed": {"at_most": 1.25}})
    assert found.verdict == REPRODUCED
    assert found.rows[0].value.startswith("1.02")
    assert found.rows[0].second_title == "error above the floor"
    assert found.rows[0].second_value.startswith("3")


def test_no_pose_counts_as_a_longest_side_and_lengths_as_sides_of_the_source():
    pose = json.dumps([[0.0, -2.0, 5.0], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    runs = runs_of("paper", rmse=0.1, rmse_excess=0.06, T_reference=pose)
    runs.loc[0, ["rmse", "rmse_excess"]] = np.nan
    known = evidence(runs).experiments["paper2d"].runs
    assert known["error"].iloc[0] == known["excess"].iloc[0] == 1.0
    np.testing.assert_allclose(known["error"].iloc[1:], 0.05)
    np.testing.assert_allclose(known["excess"].iloc[1:], 0.03)


def test_wrong_poses_search_errors_and_certificates_are_distinguished():
    runs = runs_of("paper")
    runs.loc[0, ["success", "verdict", "rmse"]] = False, "search_error", np.nan
    runs.loc[1, ["success", "verdict", "rmse"]] = False, "model_error", 3.0
    runs.loc[2, "certificate_scope"] = "translation in norm space"
    runs.loc[3, "status"] = "time_limit"
    known = evidence(runs).experiments["paper2d"].runs.head(5)
    assert list(known["wrong"]) == [True, True, False, False, False]
    assert list(known["search_error"]) == [1, 0, 0, 0, 0]
    assert list(known["certified"]) == [True, True, False, False, True]
    assert list(known["rmse"]) == [3.0, 3.0, 0.05, 0.05, 0.05]  # no pose: the worst of all


def test_a_run_at_a_limit_counts_its_own_time_and_one_without_a_pose_its_limit():
    runs = runs_of("paper", time_solve_s=3.0)
    runs.loc[0, "outcome"], runs.loc[1, ["outcome", "time_solve_s"]] = "limited", ["failed", np.nan]
    assert list(evidence(runs).experiments["paper2d"].runs["time"][:3]) == [3.0, 10.0, 3.0]


def test_instances_are_paired():
    ours = runs_of("paper", rmse=error(0.05))
    rival = runs_of("rival", rmse=error(0.1))
    unmatched = rival.assign(instance_id="other", run_id="other", rmse=0.001)
    found = judged(evidence(ours, rival, unmatched), RATIO)
    assert (found.verdict, found.runs) == (REPRODUCED, 180)
    assert "other" not in set(found.data["run_id"])


# --- verdicts -----------------------------------------------------------------------------------


@pytest.mark.parametrize("check", [RATIO, VALUE, LOW, RISE, SCATTER, SLOPE, TREND, RACE, REGRET])
def test_without_the_method_a_claim_is_not_run(check):
    found = judged(evidence(runs_of("pa")), check)
    assert found.verdict == NOT_RUN
    assert "not in the tables" in found.reason
    assert judged(Evidence({}, {}), check).verdict == NOT_RUN


def test_a_method_that_never_ran_is_not_in_the_tables():
    absent = runs_of("rival", outcome="unavailable", status="unavailable")
    found = judged(evidence(runs_of("paper"), absent), RATIO)
    reason = "not in the tables: RPM-HTB; make the tables with make paper-2d"
    assert (found.verdict, found.reason) == (NOT_RUN, reason)


def test_every_rival_and_test_has_a_verdict_of_its_own():
    worse, better = runs_of("rival", rmse=error(0.1)), runs_of("pa", rmse=error(0.02))
    check = {**RATIO, "rivals": ["rpm_htb", "rpm_pa", "rpm_cav"]}
    found = judged(evidence(runs_of("paper"), worse, better), check)
    rows = {row.rival: (row.group, row.verdict) for row in found.rows}
    assert rows == {"rival": ("noise", REPRODUCED), "pa": ("noise", NOT)}
    assert found.verdict == NOT
    assert found.reason.startswith(
        "of 2 comparisons with a rival or threshold, 1 reproduced, 1 not"
    )
    assert "RPM-CAV" in found.reason
    assert "RPM-CAV" in found.tested.partition("not tested: ")[2]
    assert found.runs == 180  # of the row that decides


def test_holding_against_some_rivals_or_at_some_levels_only_is_open():
    both = evidence(runs_of("paper"), runs_of("rival", rmse=0.1))
    found = judged(both, {**RATIO, "rivals": ["rpm_htb", "rpm_pa"]})
    assert found.verdict == OPEN
    assert "RPM-PA" in found.reason
    assert judged(both, {**VALUE, "levels": [0.1, 0.2]}).verdict == REPRODUCED
    found = judged(both, {**VALUE, "levels": [0.2, 0.3]})
    assert found.verdict == OPEN
    assert "agrees with the claim; not in the tables: level 0.3" in found.reason
    found = judged(both, {**VALUE, "tests": ["noise", "deformation"]})
    assert found.verdict == OPEN
    assert "deformation" in found.reason


def test_levels_beyond_the_axes_of_the_paper_count_only_where_they_are_listed():
    runs = runs_of("paper", rmse=lambda level, draw: 0.5 if level > 0.1 else 0.05 * draw)
    runs = runs.assign(test="mixed_outliers", level=5 * runs["level"])  # 0, 0.5, 1
    assert judged(evidence(runs), VALUE).verdict == REPRODUCED
    top = {**VALUE, "levels": "top"}
    assert figures({**top, "levels": [1.0]}, runs) == [(0.5, TRIALS)]
    assert "mixed outliers, level 0.5" in judged(evidence(runs), top).evidence


def test_the_only_level_of_a_test_is_not_its_bottom():
    found = judged(evidence(runs_of("paper").query("level == 0.2")), {**VALUE, "levels": "bottom"})
    assert found.verdict == NOT_RUN
    assert "DC-Reg as published in these tests and levels" in found.reason


def test_a_check_without_a_comparison_leaves_the_claim_open():
    rising = {**RISE, "methods": ["dcreg_paper"], "levels": [0.1]}
    found = judged(evidence(runs_of("paper")), VALUE, rising)
    assert found.verdict == OPEN
    assert "a second level of noise" in found.reason


def test_one_level_against_refutes_and_is_the_evidence():
    ours = runs_of("paper", rmse=lambda level, draw: draw * (0.3 if level == 0.1 else 0.05))
    found = judged(evidence(ours, runs_of("rival", rmse=error(0.1))), RATIO)
    assert found.verdict == NOT
    assert "noise, level 0.1" in found.evidence
    (row,) = found.rows
    assert [each.verdict for each in row.decided] == [REPRODUCED, NOT, REPRODUCED]


@pytest.mark.parametrize(("least", "verdict"), [(0.1, REPRODUCED), (0.5, NOT)])
def test_one_comparison_is_enough_for_a_claim_with_any(least, verdict):
    ours = runs_of("paper", rmse=lambda level, draw: draw * (least if level == 0.1 else 0.9))
    check = {**RATIO, "by": ["level"], "any": True}
    assert judged(evidence(ours, runs_of("rival", rmse=0.2)), check).verdict == verdict


def test_what_stands_beside_decides_nothing():
    beside = {**RATIO, "beside": True}
    found = judged(evidence(runs_of("paper"), runs_of("rival", rmse=0.01)), VALUE, beside)
    assert found.verdict == REPRODUCED
    assert [row.beside for row in found.rows] == [False, True]
    assert "RPM-HTB" not in judged(evidence(runs_of("paper")), VALUE, beside).reason


def test_answers_at_the_limit_count_in_full_experiments_and_the_limit_is_named():
    rival = limited(runs_of("rival", rmse=0.1), 5)
    found = judged(evidence(runs_of("paper"), rival), RATIO)
    assert (found.verdict, found.limited, found.runs) == (REPRODUCED, 15, 180)
    assert "15 of 180 deciding runs hit a limit (10 s); their answers at the limit" in found.reason
    quick = judged(evidence(runs_of("paper"), rival, name="paper2d-quick"), RATIO)
    assert quick.verdict == OPEN
    assert "full experiment" in quick.rows[0].instances
    assert quick.command == "make paper-2d QUICK=1"


@pytest.mark.parametrize(("side", "verdict"), [("above", REPRODUCED), ("below", NOT)])
def test_a_run_at_a_limit_took_at_least_its_time(side, verdict):
    slow = limited(runs_of("paper", time_solve_s=5.0), TRIALS)
    check = {**TIME, "claimed": {side: 1.0}}
    assert judged(evidence(slow, runs_of("rival")), check).verdict == verdict


@pytest.mark.parametrize("claimed", [{"above": 1.0}, {"below": 1.0}, {"within": [0.8, 1.25]}])
def test_time_outs_leave_claims_about_time_open_where_they_could_change_them(claimed):
    slow = runs_of("paper", time_solve_s=5.0)
    found = judged(evidence(slow, limited(runs_of("rival"), 1)), {**TIME, "claimed": claimed})
    assert found.verdict == OPEN
    assert "time-outs: needs a longer limit" in found.reason


@pytest.mark.parametrize(("count", "verdict"), [(3, REPRODUCED), (15, OPEN)])
def test_few_time_outs_do_not_change_a_median(count, verdict):
    check = {**VALUE, "quantity": "time", "statistic": "median", "claimed": {"at_most": 10}}
    runs = limited(runs_of("paper", time_solve_s=error(2.0)), count, time_solve_s=9.0)
    assert judged(evidence(runs), check).verdict == verdict


def test_a_miss_at_the_limit_could_become_a_hit():
    late = limited(runs_of("paper", objective=1.05), 5, objective=2.0)
    assert judged(evidence(runs_of("ours"), late), REGRET).verdict == OPEN
    reached = limited(runs_of("paper", objective=1.05), 5)
    assert judged(evidence(runs_of("ours"), reached), REGRET).verdict == REPRODUCED


def test_few_instances_decide_nothing_and_the_needed_number_is_stated():
    few = [runs.query("trial < 19") for runs in (runs_of("paper"), runs_of("rival", rmse=0.5))]
    found = judged(evidence(*few), RATIO)
    assert found.verdict == OPEN
    assert found.reason.startswith(f"has 19 instances, needs {MIN_INSTANCES}")
    enough = [runs.query("trial < 20") for runs in (runs_of("paper"), runs_of("rival", rmse=0.5))]
    assert judged(evidence(*enough), RATIO).verdict == REPRODUCED


def test_one_wrong_certificate_refutes_that_there_are_none():
    (claim,) = (claim for claim in ledger().claims if claim.id == "eps-min")
    right = [runs_of(name) for name in ("paper", "half", "ours")]
    assert judge_claim(ledger(), claim, evidence(*right)).verdict == REPRODUCED
    for column in ("bound_violation", "lower_bound"):
        wrong = [right[0].copy(), *right[1:]]
        wrong[0].loc[7, [column, "status", "outcome"]] = 1.1, "time_limit", "limited"
        assert judge_claim(ledger(), claim, evidence(*wrong)).verdict == NOT


def test_a_verdict_names_the_reconstructions_that_it_relies_on():
    both = evidence(runs_of("paper"), runs_of("rival", rmse=0.1))
    assert judged(both, RATIO).reconstruction == "RPM-HTB"
    assert judged(both, VALUE).reconstruction == ""


def test_the_sentence_of_a_verdict_states_data_and_machine():
    both = evidence(runs_of("paper"), runs_of("rival"))
    found = judged(both, RATIO).tested
    assert found.startswith(
        "Tested: paper against rival on fish (98 to 98 points) in noise, 90 inst"
    )
    assert "processor" not in found
    assert "paper: Python" in judged(both, TIME).tested
    assert "a processor" in judged(both, TIME).tested


# --- the ledger itself --------------------------------------------------------------------------


def test_ledger_holds_the_claims_with_command_and_check():
    book = ledger()
    assert len({claim.id for claim in book.claims}) == len(book.claims)
    for claim in book.claims:
        assert claim.checks
        assert claim.quote
        assert claim.test
        assert claim.experiment in book.commands


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("kind: boxes", "kind: boxen", "no check 'boxen'"),
        ("subject: dcreg_paper_half", "subject: dcreg_third", "no role 'dcreg_third'"),
        ("experiment: bounds", "experiment: bonds", "no command makes 'bonds'"),
        ("apart: proof", "apart: prof", "apart is 'prof'"),
    ],
)
def test_ledger_that_names_what_is_not_there_is_refused(tmp_path, old, new, message):
    path = tmp_path / "claims.yaml"
    path.write_text(LEDGER.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ReportError, match=re.escape(message)):
        Ledger.read(path)


def test_every_role_is_found_in_the_cards():
    for role in ledger().roles.values():
        for baseline in role.baseline:
            parameters = registry.read_card(baseline).parameters
            for option in {**role.options, **role.without}:
                assert option in parameters, (role.name, baseline, option)


@pytest.mark.parametrize("experiment", ["paper2d", "paper2d_images", "paper3d", "threedmatch"])
def test_every_role_of_a_claim_is_played_by_a_method_of_its_experiment(experiment):
    settings = [
        (m.baseline, registry.effective_options(m.baseline, m.options), m.n_inliers_ratio)
        for m in load(experiment).methods
    ]
    named = {
        role
        for claim in ledger().claims
        for entry in claim.checks
        for role in roles_of(entry)
        if claim.experiment == experiment
    }
    assert named
    vacant = [r for r in named if not any(ledger().roles[r].fit(*each) for each in settings)]
    assert not vacant


def test_a_role_refuses_effective_options_that_were_not_given():
    """Two runs without given options differ if the defaults of the card do."""
    role, runs = ledger().roles["dcreg_paper"], runs_of("paper").assign(options="{}")
    assert evidence(runs).experiments["paper2d"].methods_in(role) == ["paper"]
    other = json.loads(PAPER) | {"epsilon_factor": 0.03}
    changed = runs.assign(options_effective=json.dumps(other))
    assert evidence(changed).experiments["paper2d"].methods_in(role) == []
    assert judged(evidence(changed), VALUE).verdict == NOT_RUN
    unknown = runs.assign(options_effective="{}")
    assert evidence(unknown).experiments["paper2d"].methods_in(role) == []


def test_the_plan_states_the_effective_options():
    experiment = load("demo")
    planned = plan_table(expand(experiment)).drop_duplicates("method").set_index("method")
    for method in experiment.methods:
        given, effective = (
            json.loads(planned.loc[method.name, column])
            for column in ("options", "options_effective")
        )
        assert effective == {**registry.read_card(method.baseline).parameters, **given}


def test_roles_prefer_the_first_front_end_and_leave_out_oracles():
    role = ledger().roles["teaser"]
    options = {"threshold": "paper", "front_end": "norm-signature"}
    plain, other, oracle = (
        role.fit("teaser", {**options, "front_end": front})
        for front in ("norm-signature", "fpfh-mutual", "oracle")
    )
    assert plain < other
    assert oracle is None
    assert role.fit("teaser", {**options, "threshold": "given"}) is None
    assert role.fit("teaser", options, 0.5) is None
    assert ledger().roles["teasers"].fit("teaser", {**options, "front_end": "oracle"}) is None


def test_claims_about_dc_reg_are_about_the_published_method():
    allowed = {"bound-explains": {"dcreg_dc"}, "no-sacrifice": {"dcreg_full"}}
    for claim in ledger().claims:
        for entry in claim.checks:
            named = {role for role in roles_of(entry) if role.startswith("dcreg")}
            ours = {role for role in named if not role.startswith("dcreg_paper")}
            assert entry.get("beside") or ours <= allowed.get(claim.id, set()), claim.id


# --- folders and pages --------------------------------------------------------------------------


def test_a_folder_of_another_name_is_noted(tmp_path):
    for folder in ("a-trial", "paper2d"):
        report_fixture.write_tables(tmp_path / folder / "tables", experiment="paper2d")
    (note,) = Evidence.of_folders([tmp_path]).notes
    assert f"those in {tmp_path / 'a-trial'}" in note
    (note,) = Evidence.of_folders([tmp_path / "a-trial"]).notes
    assert f"{tmp_path / 'a-trial'}, a folder of another name" in note


@pytest.mark.parametrize(
    ("name", "variables"),
    [("paper2d", ""), ("paper2d-quick", " QUICK=1"), ("paper2d-40", " POINTS=40"),
     ("paper2d-40-quick", " POINTS=40 QUICK=1")],
)  # fmt: skip
def test_parts_of_an_experiment_are_the_same_claims_with_another_command(tmp_path, name, variables):
    report_fixture.write_tables(tmp_path / name / "tables", experiment=name)
    found = Evidence.of_folders([tmp_path])
    assert set(found.experiments) == {"paper2d"}
    assert found.experiments["paper2d"].variables == variables


def test_the_whole_comes_before_its_parts(tmp_path):
    kinds = ("paper2d-40-quick", "paper2d-quick", "paper2d-40", "paper2d")
    for at, name in enumerate(kinds):
        report_fixture.write_tables(tmp_path / name / "tables", experiment=name)
        found = Evidence.of_folders([tmp_path])
        assert found.experiments["paper2d"].tables.experiment == name
        assert len(found.notes) == at


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """A folder of results with the experiments of two claims, and the study of bounds."""
    root = tmp_path_factory.mktemp("results")
    for name in ("half-2d", "low-3d", "tight-laps"):
        (claim,) = (claim for claim in ledger().claims if claim.id == name)
        claim_tables.write(ledger(), claim, root, true=name != "low-3d", trials=12)
    return root


@pytest.fixture(scope="module")
def written(results) -> Path:
    """The folder that the command wrote."""
    out = results.parent / "claims"
    answer = CliRunner().invoke(app, ["claims", str(results), "--out", str(out)])
    assert answer.exit_code == 0, answer.output
    return out


def test_command_writes_page_data_and_tables(written):
    out = written
    table = pd.read_csv(out / "claims.csv").set_index("id")
    assert len(table) == len(ledger().claims)
    wanted = {"half-2d": REPRODUCED, "low-3d": NOT, "tight-laps": REPRODUCED, "centre": APART}
    assert {name: table.loc[name, "verdict"] for name in wanted} == wanted
    for row in table[table["verdict"] == NOT_RUN].itertuples():
        assert row.reason.endswith(f"with {row.command}")
    assert table[["command", "reason", "tested"]].notna().all(axis=None)
    page = (out / PAGE).read_text(encoding="utf-8")
    assert "Available tables: paper2d, paper3d, bounds." in page
    ids = re.findall(r'<article class="claim" id="([\w-]+)">', page)
    assert sorted(ids) == sorted(claim.id for claim in ledger().claims)
    for link in re.findall(r'href="([^"#]+)"', page):
        assert (out / link).is_file(), link
    data = pd.read_csv(out / "data" / "half-2d.csv")
    assert set(data["method"]) == {"dcreg_paper_half", "rpm_htb", "rpm_pa", "rpm_cav"}
    assert len(data) == table.loc["half-2d", "runs"]
    comparisons = pd.read_csv(out / "comparisons.csv")
    of_claim = comparisons[comparisons["claim"] == "half-2d"]
    assert len(of_claim) == 2 * 5 * 3
    assert page.count('<svg class="strip') >= of_claim.groupby(["rival", "group"]).ngroups


def test_a_verdict_against_reconstructions_says_so_in_its_first_line(written):
    page = (written / PAGE).read_text(encoding="utf-8")
    (article,) = re.findall(r'<article class="claim" id="half-2d">.*?</article>', page, re.DOTALL)
    first = re.search(r"<p>(.*?)</p>", article, re.DOTALL)[1]
    assert "not reproduced" not in first
    assert "against reconstructions: RPM-HTB, RPM-PA, RPM-CAV" in first


def test_changes_against_an_earlier_ledger_are_listed(results, written, tmp_path):
    command = ["claims", str(results), "--out", str(tmp_path / "now")]
    before = pd.read_csv(written / "claims.csv")
    before.loc[before["id"] == "half-2d", "verdict"] = "inconclusive"
    before[before["id"] != "low-3d"].to_csv(tmp_path / "before.csv", index=False)
    answer = CliRunner().invoke(app, [*command, "--before", str(tmp_path / "before.csv")])
    changes = answer.output.partition("before")[2]
    assert re.search(r"half-2d\s*│\s*inconclusi", changes)
    assert re.search(r"low-3d\s*│\s*absent", changes)
    assert "half-occl" not in changes
    answer = CliRunner().invoke(app, [*command, "--before", str(tmp_path / "none.csv")])
    assert answer.exit_code == 2
    assert "none.csv: no such file" in answer.output


def test_a_report_of_one_experiment_finds_the_study_next_to_it(results):
    tables = Tables.load(results / "paper2d" / "tables")
    found = Evidence.of_tables(tables)
    assert set(found.study) == {"boxes", "searches"}
    counts = dict(count(judge(ledger(), found, {"paper2d"})))
    assert sum(counts.values()) == sum(claim.experiment == "paper2d" for claim in ledger().claims)


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


def test_a_claim_is_not_changed_by_what_another_one_needs():
    """Holm's correction is within a claim: its comparisons, not those of the ledger, are counted."""
    both = evidence(runs_of("paper", rmse=error(0.05)), runs_of("rival", rmse=error(0.06)))
    claim = Claim("c", "q", "t", "paper2d", (RATIO,))
    book = replace(ledger(), claims=(claim,) * 3)
    alone = judge_claim(book, claim, both)
    assert {j.rows[0].shown.level for j in judge(book, both)} == {alone.rows[0].shown.level}
