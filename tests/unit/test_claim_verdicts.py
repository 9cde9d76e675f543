"""How comparisons, limits and missing methods make the verdict of a claim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from claim_fixture import (
    LEVELS,
    LOW,
    RACE,
    RATIO,
    REGRET,
    RISE,
    SCATTER,
    SENSITIVITY,
    SLOPE,
    TIME,
    TREND,
    TRIALS,
    VALUE,
    error,
    evidence,
    figures,
    history,
    judged,
    limited,
    runs_of,
    spread_over,
)
from report_fixture import write_tables

from reports.figures import bounds, profile
from reports.ledger.book import ledger
from reports.ledger.evidence import Evidence, Experiment
from reports.ledger.finding import Finding, Part
from reports.ledger.intervals import (
    LEVEL,
    MIN_TRIALS,
    NOT,
    NOT_RUN,
    OPEN,
    REPRODUCED,
    Share,
)
from reports.ledger.judging import judge_claim
from reports.ledger.verdicts import decide
from reports.tables import Tables
from reports.theme import method_styles
from workflows.outcomes import NOT_NEEDED

# --- verdicts --------------------------------------------------------------------------------------


@pytest.mark.parametrize("check", [RATIO, VALUE, LOW, RISE, SCATTER, SLOPE, TREND, RACE, REGRET])
def test_without_the_method_a_claim_is_not_run(check):
    found = judged(evidence(runs_of("pa")), check)
    assert found.verdict == NOT_RUN
    assert "not in the tables" in found.reason
    assert judged(Evidence({}, {}), check).verdict == NOT_RUN


def test_a_method_that_never_ran_is_not_in_the_tables():
    absent = runs_of("rival", outcome="unavailable", status="unavailable")
    found = judged(evidence(runs_of("paper"), absent), RATIO)
    reason = "not in the tables: RPM-HTB; run the experiment: make paper-2d"
    assert (found.verdict, found.reason) == (NOT_RUN, reason)


def test_every_rival_and_test_has_a_verdict_of_its_own():
    worse, better = runs_of("rival", rmse=error(0.1)), runs_of("pa", rmse=error(0.02))
    check = {**RATIO, "rivals": ["rpm_htb", "rpm_pa", "rpm_cav"]}
    found = judged(evidence(runs_of("paper"), worse, better), check)
    rows = {row.rival: (row.group, row.verdict) for row in found.rows}
    assert rows == {"rival": ("noise", REPRODUCED), "pa": ("noise", NOT)}
    assert found.verdict == NOT
    assert found.reason.startswith("2 comparisons with a rival or threshold: 1 reproduced, 1 not")
    assert "RPM-CAV" in found.reason
    assert "RPM-CAV" in found.tested.partition("not tested: ")[2]
    assert found.runs == 180  # of the row that decides


def test_planned_comparisons_without_runs_take_part_in_the_correction():
    """Otherwise the first comparison that is run would be decided at too lenient a level."""
    finding = Finding(
        "figure",
        parts=[Part("a", "b", "noise", "", Share(0.85, 40), {"above": 0.6}, instances=40)],
    )
    for missing, level in ((0, LEVEL), (9, LEVEL / 10)):
        ((found,),) = decide([finding], quick=False, missing=missing)
        assert found.level == level
        assert found.verdict == (REPRODUCED if level == LEVEL else OPEN)


def planning(found: Evidence, **tests: list[float]) -> Evidence:
    """The evidence of blocks of an experiment with these levels of tests."""
    (experiment,) = found.experiments.values()
    entry = {"dataset": "d", "shapes": ["fish"], "tests": tests}
    provenance = {**experiment.tables.provenance, "config": {"datasets": [entry]}}
    runs = experiment.tables.runs
    left_out = runs.head(1).assign(run_id="left out", method="another", outcome=NOT_NEEDED)
    tables = replace(
        experiment.tables,
        provenance=provenance,
        runs=pd.concat([runs, left_out], ignore_index=True),
    )
    return Evidence({"paper2d": Experiment(tables)}, {})


def test_a_claim_is_reproduced_by_all_of_its_planned_comparisons_only():
    found = evidence(runs_of("paper", rmse=error(0.05)), runs_of("rival", rmse=error(0.1)))
    levels = sorted(found.experiments["paper2d"].runs["level"].unique())
    assert judged(planning(found, noise=levels), RATIO).verdict == REPRODUCED
    partly = judged(planning(found, noise=levels, deformation=[0.01, 0.02]), RATIO)
    assert partly.verdict == OPEN
    assert f"2 of {len(levels) + 2} planned comparisons" in partly.reason
    named = judged(planning(found, noise=levels, deformation=[0.01]), {**RATIO, "tests": ["noise"]})
    assert named.verdict == REPRODUCED


def test_a_figure_about_all_levels_has_trials_with_all_of_them_only():
    """Other claims may need more trials of some levels, where the figure differs."""
    ours, theirs = runs_of("paper", rmse=error(0.05)), runs_of("rival", rmse=error(0.1))
    levels = sorted(ours["level"].unique())
    cut = [runs[(runs["level"] == levels[0]) | (runs["trial"] < 5)] for runs in (ours, theirs)]
    pooled = {**RATIO, "by": ["test"]}
    each = sorted([5] * (len(levels) - 1) + [ours["trial"].nunique()])
    for check, trials, instances in ((pooled, [5], [5 * len(levels)]), (RATIO, each, each)):
        found = judged(planning(evidence(*cut), noise=levels), check)
        parts = [d.part for row in found.rows for d in row.decided]
        assert sorted(part.estimate.n for part in parts) == trials
        assert sorted(part.instances for part in parts) == instances


@pytest.mark.parametrize(
    ("levels", "verdict"), [([0.0, 0.1, 0.2], REPRODUCED), ([0.0, 0.1], NOT_RUN)]
)
def test_the_top_of_a_block_is_the_planned_one(levels, verdict):
    """The highest level that some claim needed so far is not the top."""
    ours, theirs = runs_of("paper", rmse=error(0.05)), runs_of("rival", rmse=error(0.1))
    kept = [runs[runs["level"].isin(levels)] for runs in (ours, theirs)]
    found = judged(planning(evidence(*kept), noise=[0.0, 0.1, 0.2]), {**RATIO, "levels": "top"})
    assert found.verdict == verdict
    assert found.command == "make evidence EXPERIMENTS=paper2d"
    assert ("run more blocks: make evidence EXPERIMENTS=paper2d" in found.reason) == (
        verdict == NOT_RUN
    )


@pytest.mark.parametrize(("rmse", "verdict"), [(error(0.2), REPRODUCED), (error(0.02), OPEN)])
def test_a_check_of_any_waits_for_missing_values_only_if_none_agrees(rmse, verdict):
    found = evidence(runs_of("paper", rmse=error(0.1)), runs_of("rival", rmse=rmse))
    levels = sorted(found.experiments["paper2d"].runs["level"].unique())
    check = {**RATIO, "any": True}
    assert judged(planning(found, noise=[*levels, 0.5]), check).verdict == verdict
    assert judged(planning(found, noise=levels), check).verdict == (
        REPRODUCED if verdict != OPEN else NOT
    )


def test_full_experiments_are_judged_by_their_runs():
    """Not by their config: a part of one has fewer tests and levels."""
    found = evidence(runs_of("paper", rmse=error(0.05)), runs_of("rival", rmse=error(0.1)))
    runs = found.experiments["paper2d"].tables.runs
    planned = planning(found, noise=[0.0, 0.7])
    whole = replace(planned.experiments["paper2d"].tables, runs=runs)
    assert judged(Evidence({"paper2d": Experiment(whole)}, {}), RATIO).verdict == REPRODUCED
    assert judged(planned, RATIO).verdict == OPEN


def test_runs_without_the_quantity_leave_a_value_about_all_levels_complete():
    theirs = runs_of("rival", n_nodes=lambda level, draw: np.nan if level else 200.0 * draw)
    found = planning(evidence(runs_of("paper"), theirs), noise=sorted(theirs["level"].unique()))
    verdict = judged(found, {**RATIO, "quantity": "n_nodes", "by": ["test"]})
    assert (verdict.verdict, verdict.runs) == (REPRODUCED, 60)


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
    beside = {**RATIO, "shown_only": True}
    found = judged(evidence(runs_of("paper"), runs_of("rival", rmse=0.01)), VALUE, beside)
    assert found.verdict == REPRODUCED
    assert [row.shown_only for row in found.rows] == [False, True]
    assert "RPM-HTB" not in judged(evidence(runs_of("paper")), VALUE, beside).reason


def test_answers_at_the_limit_count_in_full_experiments_and_the_limit_is_named():
    rival = limited(runs_of("rival", rmse=0.1), 5)
    found = judged(evidence(runs_of("paper"), rival), RATIO)
    assert (found.verdict, found.limited, found.runs) == (REPRODUCED, 15, 180)
    assert "15 of 180 deciding runs hit a limit (10 s)" in found.reason
    quick = judged(evidence(runs_of("paper"), rival, name="paper2d-quick"), RATIO)
    assert quick.verdict == OPEN
    assert "full experiment" in quick.rows[0].open_because
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
    assert "time-outs could change the verdict: use a longer limit" in found.reason


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
    both = (
        runs_of("paper", rmse=lambda level, draw: 0.05 + 0.001 * draw),
        runs_of("rival", rmse=0.5),
    )
    found = judged(evidence(*(runs.query("trial < 19") for runs in both)), RATIO)
    assert found.verdict == OPEN
    assert found.reason.startswith(f"has 19 trials, needs {MIN_TRIALS}")
    enough = [runs.query("trial < 20") for runs in both]
    assert judged(evidence(*enough), RATIO).verdict == REPRODUCED


ONCE = [
    RATIO, TIME, {**VALUE, "quantity": "success", "claimed": {"above": 0.5}}, LOW, REGRET, RACE,
    SENSITIVITY,
]  # fmt: skip


@pytest.mark.parametrize("check", ONCE, ids=lambda check: check["kind"])
def test_more_instances_of_the_same_trials_show_nothing_new(check):
    """Instances of a trial share their pose: if they are all alike, they are one observation."""
    one = [runs_of("paper", rmse=error(0.05), time_solve_s=error(1.0), n_nodes=error(90.0))]
    one += [runs_of(name, rmse=error(0.1), time_solve_s=error(3.0), n_nodes=error(50.0))
            for name in ("rival", "half", "pa", "ours")]  # fmt: skip
    one = [runs[runs["level"] == LEVELS[0]] for runs in one]
    traces = pd.concat([history("paper", (0.1, 0.9)), history("rival", (1.0, 0.9))])
    intervals = []
    for levels in (LEVELS[:1], LEVELS):
        repeated = [
            runs.assign(
                level=level,
                run_id=runs["run_id"].str.replace("-0.0-", f"-{level}-"),
                instance_id=runs["instance_id"].str.replace("0.0-", f"{level}-"),
            )
            for runs in one
            for level in levels
        ]
        found = judged(evidence(*repeated, traces=traces), {**check, "by": ["test"]})
        parts = [d for row in found.rows for d in row.decided]
        assert {d.part.estimate.n for d in parts} == {TRIALS}
        assert {d.part.instances for d in parts} == {TRIALS * len(levels)}
        intervals.append(np.array([d.interval for d in parts]))
    assert len(intervals[0])
    np.testing.assert_allclose(*intervals)


@pytest.mark.parametrize("check", [RATIO, SCATTER, VALUE], ids=lambda check: check["kind"])
def test_a_method_without_runs_at_some_level_leaves_a_claim_open(check):
    check = {**check, "claimed": {"below": 1.0}, "rivals": ["rpm_htb", "rpm_pa"]}
    both = [
        runs_of("paper", rmse=spread_over(0.1)),
        runs_of("rival", rmse=lambda level, draw: spread_over(0.5)(level, draw) + 0.1),
    ]
    other = runs_of("pa").assign(rmse=both[1]["rmse"]), runs_of("ours")
    assert judged(evidence(*both, *other), check).verdict == REPRODUCED
    lacking = 0 if check["kind"] == "value" else 1
    both[lacking] = both[lacking].query("level < 0.2")
    found = judged(evidence(*both, *other), check)
    assert found.verdict == OPEN
    assert f"{('paper', 'rival')[lacking]} at all of these tests and levels" in found.reason


def test_a_wrong_certificate_in_an_incomplete_trial_counts():
    (claim,) = (claim for claim in ledger().claims if claim.id == "eps-min")
    tables = [runs_of(name) for name in ("paper", "half")]
    levels = sorted(tables[0]["level"].unique())
    alone = runs_of("half", trial=99, bound_violation=1.1).head(1)
    alone = alone.assign(run_id="alone", instance_id="alone")
    for more, verdict in (([], REPRODUCED), ([alone], NOT)):
        found = planning(evidence(*tables, *more), noise=levels)
        assert judge_claim(ledger(), claim, found).verdict == verdict


def test_many_instances_of_few_trials_decide_nothing():
    both = (runs_of("paper", rmse=error(0.05)), runs_of("rival", rmse=error(0.1)))
    pooled = {**RATIO, "by": ["test"]}
    few = [runs[runs["trial"] < MIN_TRIALS - 1] for runs in both]
    found = judged(evidence(*few), pooled)
    assert (found.verdict, found.runs) == (OPEN, 2 * 3 * (MIN_TRIALS - 1))
    assert found.reason.startswith(f"has {MIN_TRIALS - 1} trials, needs {MIN_TRIALS}")
    enough = [runs[runs["trial"] < MIN_TRIALS] for runs in both]
    assert judged(evidence(*enough), pooled).verdict == REPRODUCED


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
    stage = judged(both, VALUE, reconstruction="a stage").reconstruction
    assert stage == "a stage"


def test_a_refutation_by_a_rival_alone_names_no_stage_of_ours():
    """The other check is reproduced by runs with that stage."""
    both = evidence(runs_of("paper"), runs_of("pa", rmse=0.1))
    rival = {**VALUE, "methods": ["rpm_pa"]}
    found = judged(both, VALUE, rival, reconstruction="a stage")
    assert found.verdict == NOT
    assert found.reconstruction == ""


def test_the_sentence_of_a_verdict_states_data_and_machine():
    both = evidence(runs_of("paper"), runs_of("rival"))
    found = judged(both, RATIO).tested
    assert found.startswith("Tested: paper against rival on fish (98 points) in noise, 90 inst")
    assert "processor" not in found
    assert "paper: Python" in judged(both, TIME).tested
    assert "a processor" in judged(both, TIME).tested


@pytest.mark.parametrize(
    ("fits", "poses", "verdict"), [(0.1, 0.1, REPRODUCED), (0.02, 0.02, NOT), (0.02, 0.1, OPEN)]
)
def test_methods_that_differ_by_a_choice_of_ours_must_agree(fits, poses, verdict):
    tables = [
        runs_of("paper"),
        runs_of("rival", rmse=error(fits)),
        runs_of("pose", rmse=error(poses)),
    ]
    found = judged(evidence(*tables), RATIO, choices=True)
    assert found.verdict == verdict
    assert {row.rival for row in found.rows} == {"rival", "pose"}
    needs = "not all variants of RPM-HTB agree (incumbents)"
    assert all((needs in row.open_because) == (verdict == OPEN) for row in found.rows)
    of_rivals = {**VALUE, "methods": ["rpm_htb"], "claimed": {"above": 0.05}}
    assert judged(evidence(*tables), of_rivals, choices=True).verdict == verdict


def test_variants_of_the_first_method_must_agree_as_well():
    """Also against a rival, as in `frs-crosses`."""
    check = {**RATIO, "subject": "rpm_htb", "rivals": ["dcreg_paper"]}
    paper, good = runs_of("paper"), runs_of("rival", rmse=error(0.02))
    for poses, verdict in [(0.02, REPRODUCED), (0.1, OPEN)]:
        found = judged(
            evidence(paper, good, runs_of("pose", rmse=error(poses))), check, choices=True
        )
        assert found.verdict == verdict


def test_one_of_several_choices_decides_nothing():
    found = judged(evidence(runs_of("paper"), runs_of("rival", rmse=0.01)), RATIO, choices=True)
    assert found.verdict == OPEN
    assert "RPM-HTB with the other value of the option incumbents" in found.reason


def test_a_figure_that_cannot_refute_leaves_the_claim_open():
    check = {**VALUE, "cannot_refute": "the paper's tolerance is not known"}
    low, high = (evidence(runs_of("paper", rmse=rmse)) for rmse in (0.05, 0.1))
    assert judged(low, check).verdict == REPRODUCED
    found = judged(high, check)
    assert (found.verdict, judged(high, VALUE).verdict) == (OPEN, NOT)
    assert "the paper's tolerance is not known" in found.reason


def test_a_short_time_for_fewer_points_leaves_the_claim_open():
    check = {
        "kind": "value", "quantity": "time", "statistic": "median", "methods": ["dcreg_paper"],
        "claimed": {"at_most": 10},
    }  # fmt: skip
    assert judged(evidence(runs_of("paper")), check).verdict == REPRODUCED
    fewer = judged(evidence(runs_of("paper"), name="paper2d-40"), check)
    assert fewer.verdict == OPEN
    assert "searches of fewer points" in fewer.reason
    slow = runs_of("paper", time_solve_s=20.0)
    assert judged(evidence(slow, name="paper2d-40"), check).verdict == NOT


def test_times_of_other_machines_are_not_used(tmp_path):
    tables = Tables.load(write_tables(tmp_path / "tables"))
    runs = tables.runs.copy()
    is_other = runs["trial"] == runs["trial"].max()
    runs.loc[is_other, "machine_id"] = "m1"
    mixed = Experiment(replace(tables, runs=runs))
    assert mixed.machine_id == "m0"
    other = set(runs.loc[is_other, "run_id"])
    for name in ("time", "translation_time"):
        times = mixed.runs.set_index("run_id")[name]
        alone = Experiment(tables).runs.set_index("run_id")[name]
        assert other & set(times.index)
        for run_id, time_s in times.items():
            assert np.isnan(time_s) if run_id in other else time_s == alone[run_id]
    figure = bounds.build(mixed.tables, method_styles(tables))
    drawn = [each for instance in figure.payload["instances"] for each in instance["runs"]]
    assert {each["run"] in other for each in drawn} == {True, False}
    for each in drawn:
        for stage in each["stages"].values():
            assert all((time is None) == (each["run"] in other) for time in stage["time"])
    shown, whole = (
        [
            trace
            for trace in profile.build(each, method_styles(tables), "rigid3d").traces
            if trace["meta"]["role"] == "profile"
        ]
        for each in (mixed.tables, tables)
    )
    complete = [max(trace["y"]) == 1.0 for trace in whole]
    assert any(complete)
    for trace, is_complete in zip(shown, complete, strict=True):  # other machines lower no curve
        assert max(trace["y"]) == 1.0 or not is_complete
