"""Every kind of check of the ledger can say all three verdicts, and takes the right runs."""

from __future__ import annotations

import json

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
    noisy,
    runs_of,
    spread_over,
)
from typer.testing import CliRunner

from reports.__main__ import app
from reports.ledger import checks
from reports.ledger.evidence import Evidence
from reports.ledger.finding import CHECKS, Source, limits, select
from reports.ledger.intervals import NOT, NOT_RUN, OPEN, REPRODUCED
from reports.tables import is_refuted, thinned
from workflows.outcomes import comparable_times, is_timed

# --- every kind of check ---------------------------------------------------------------------------

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
    (REGRET, [("ours", {}), ("paper", {"objective": 1.15})], REPRODUCED),  # both tolerances are 0.1
    (REGRET, [("ours", {}), ("paper", {"objective": 1.25})], NOT),
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
    ("mine", "theirs", "verdict"), [(0.1, 1.0, REPRODUCED), (1.0, 0.1, NOT), (0.5, 1.0, OPEN)]
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
            {"instance": "i", "trial": d, "place": "p", "width": 1.0, "bound": b, "value": v}
            for d in range(100)
            for b, v in (("dc", 2.0), ("termwise-r1", 2.0 - (sign if sign else d % 10 - 0.5)))
        ]
    )


def _orders(sign: int) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "instance": "i", "trial": draw, "place": "holding", "width": width, "bound": "dc",
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
            {
                "instance": i % 6,
                "trial": i // 6,
                "bound": b,
                "n_assignments": n,
                "gap": g if n else 100.0,
            }
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
    of_study = {name for name, kind in CHECKS.items() if kind.of_study}
    assert {check["kind"] for check, *_ in STUDY} == of_study


def test_boxes_compare_values_below_zero_and_can_be_of_some_instances_only():
    check, _, make = STUDY[0]
    table = pd.concat([make(1).assign(instance="2D fish"), make(-1).assign(instance="3D horse")])
    for shift, shares in ((0.0, [(1.0, 100), (0.0, 100)]), (-9.0, [(1.0, 100), (0.0, 100)])):
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


# --- choice and values of runs ---------------------------------------------------------------------


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
    assert figures(closed, runs_of("paper"), late) == [(pytest.approx(0.5), 20)]
    ours = runs_of("ours")
    ours.loc[ours["trial"] < 10, ["status", "objective"]] = "time_limit", 0.1
    of_all = {**REGRET, "by": ["model"]}
    assert figures(of_all, ours, runs_of("paper", objective=1.05)) == [(1.0, 20)]
    failed = runs_of("paper", objective=1.05)
    failed.loc[failed["trial"] >= 20, ["verdict", "objective"]] = "no_pose", np.nan
    assert figures(of_all, ours, failed) == [(0.5, 20)]


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
    unpaired = {**check, "paired_levels": False}
    alone["shape"] = "sun3d-hotel"
    assert figures(unpaired, alone) == [(pytest.approx(1.0), 3 * TRIALS)]
    alone["shape"] = alone["instance_id"]
    assert figures(check, alone) == []


def test_pairs_of_scans_with_the_same_number_are_not_one_trial():
    """Their number begins anew in each range of overlaps."""
    runs = runs_of("paper")
    for shape, number in (("fish", TRIALS), ("7-scenes-redkitchen", 3 * TRIALS)):
        assert figures({**VALUE, "by": ["test"]}, runs.assign(shape=shape)) == [(0.05, number)]


def test_levels_with_few_scans_make_the_slope_uncertain():
    """One pair at each end of the overlaps has the most leverage."""
    rng, wrong = np.random.default_rng(3), 0
    level = np.repeat([0.1, 0.3, 0.5, 0.7, 0.9], [1, 30, 60, 30, 1])
    for _ in range(100):
        error = rng.choice([0.1, 2.0], len(level), p=[0.8, 0.2])
        runs = pd.DataFrame({"level": level, "error": error, "unit": range(len(level))})
        low, high = checks._slope_of_instances(runs, "error").interval(0.05)
        wrong += not low <= 0.0 <= high
    assert wrong <= 5


def test_scatter_is_that_within_shapes():
    steady, loose = (
        runs_of(name, rmse=spread_over(width)) for name, width in (("paper", 0.1), ("rival", 0.5))
    )
    alike = figures(SCATTER, steady, loose)
    two = [
        pd.concat([
            runs,
            runs.assign(
                shape="fu", rmse=runs["rmse"] + 3.0, run_id=runs["run_id"] + "b",
                instance_id=runs["instance_id"] + "b",
            ),
        ])
        for runs in (steady, loose)
    ]  # fmt: skip
    assert figures(SCATTER, *two) == [(pytest.approx(alike[0][0]), 2 * TRIALS)]


def test_race_ends_at_the_gap_that_both_reached():
    ours = history("paper", (0.0, 0.0), (1.0, 0.5), (5.0, 1.0))
    traces = pd.concat([ours, history("rival", (0.0, 0.0), (4.0, 0.5))])
    both = runs_of("paper"), runs_of("rival")
    assert figures(RACE, *both, traces=traces) == [(pytest.approx(0.25), TRIALS)]


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


def test_a_race_tells_on_how_many_instances_neither_has_a_bound():
    ends = [history(m, (0.0, 0.0), (s, 1.0)) for m, s in (("paper", 1.0), ("rival", 6.0))]
    left_out = runs_of("paper")["run_id"].iloc[:9], runs_of("rival")["run_id"].iloc[:9]
    traces = pd.concat(ends)
    traces = traces[~traces["run_id"].isin(pd.concat(left_out))]
    found = judged(evidence(runs_of("paper"), runs_of("rival"), traces=traces), RACE)
    assert found.verdict != REPRODUCED
    assert "a bound above 0 of paper or rival for 9 of 90 instances" in found.reason


def test_times_with_other_numbers_of_parallel_jobs_are_not_compared():
    crowded = runs_of("rival", time_solve_s=lambda level, draw: 9.0)
    crowded["parallel_jobs"] = 2.0
    runs = pd.concat([runs_of("paper"), runs_of("paper").iloc[:5], crowded])
    assert is_timed(runs).tolist() == [True] * 95 + [False] * len(crowded)
    assert comparable_times(runs).isna().sum() == len(crowded)
    other_test = pd.concat([runs_of("paper"), crowded.assign(test="deformation")])
    assert is_timed(other_test).all()
    assert is_timed(runs.assign(parallel_jobs=np.nan)).all()


def test_times_are_compared_only_where_equally_many_jobs_ran():
    paper, rival = runs_of("paper", time_solve_s=2.0), runs_of("rival")
    rival["parallel_jobs"] = np.where(rival["trial"] < 20, 1.0, 2.0)
    time = {**TIME, "by": ["test"]}
    assert figures(time, paper, rival) == [(pytest.approx(2.0), 20)]
    rival.loc[rival["trial"] < 10, "parallel_jobs"] = np.nan
    assert figures(time, paper, rival) == [(pytest.approx(2.0), 10)]
    unknown = {"parallel_jobs": np.nan}
    assert figures(time, paper.assign(**unknown), rival.assign(**unknown))[0][1] == TRIALS
    ratio = {**RATIO, "by": ["test"]}
    assert figures(ratio, paper, rival)[0][1] == TRIALS  # errors do not depend on other jobs


def test_the_open_gap_of_an_exact_fit_is_0_and_that_of_a_run_without_bounds_is_1():
    paper = runs_of("paper")
    exact, lost = paper["trial"] == 0, paper["trial"] == 1
    paper.loc[exact, ["lower_bound", "upper_bound", "gap", "bound_ratio"]] = 0.0, 1e-31, 1e-31, 1.0
    paper.loc[lost, ["lower_bound", "upper_bound", "gap", "bound_ratio"]] = np.nan
    without = runs_of("pa", lower_bound=np.nan, upper_bound=np.nan, gap=np.nan, bound_ratio=np.nan)
    runs = evidence(paper, without).experiments["paper2d"].runs
    gaps = runs.loc[runs["method"] == "paper", "open_gap"].to_numpy()
    assert gaps[exact] == pytest.approx(0.0)
    assert gaps[lost] == pytest.approx(1.0)
    assert gaps[~(exact | lost)] == pytest.approx(0.05)
    assert runs.loc[runs["method"] == "pa", "open_gap"].isna().all()


def test_a_race_does_not_depend_on_whether_a_history_was_archived():
    steps = [(float(at), at / 1000) for at in range(1001)]
    rival = history("rival", (0.0, 0.0), (400.0, 0.3337))
    whole, both = history("paper", *steps), (runs_of("paper"), runs_of("rival"))
    found = figures(RACE, *both, traces=pd.concat([whole, rival]))
    assert found == figures(RACE, *both, traces=pd.concat([thinned(whole), rival]))


def test_a_cost_that_doubles_is_as_sensitive_as_one_that_halves():
    tables = [("half", 50.0), ("paper", 100.0), ("pa", 400.0), ("rival", 100.0)]
    runs = [runs_of(name, n_nodes=value) for name, value in tables]
    assert figures(SENSITIVITY, *runs) == [(pytest.approx(0.5), TRIALS)]
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


@pytest.mark.parametrize("change", [{"bound": "paper"}, {"trial": None}])
def test_a_study_of_an_earlier_version_is_refused_with_its_command(tmp_path, change):
    for _, name, make in STUDY:
        table = make(1).assign(**change).dropna(axis="columns", how="all")
        table.to_csv(tmp_path / f"{name}.csv", index=False)
    answer = CliRunner().invoke(app, ["claims", str(tmp_path), "--out", str(tmp_path)])
    assert answer.exit_code == 2
    assert "make them again with `make bounds`" in answer.output


@pytest.mark.parametrize(("claimed", "verdict"), [({"above": 0}, OPEN), ({"at_most": 0.2}, OPEN)])
def test_work_at_the_limit_of_every_level_shows_no_trend(claimed, verdict):
    """Boxes at the limit fall with the level, as each takes longer; the work itself is not known."""
    boxes = limited(runs_of("paper", n_nodes=lambda level, draw: 1000 - 3000 * level), TRIALS)
    check = {**TREND, "quantities": ["n_nodes"], "claimed": claimed}
    found = judged(evidence(boxes), check)
    assert found.verdict == verdict
    assert "time-outs could change the verdict" in found.reason


def test_a_trend_to_the_limit_is_a_trend():
    runs = runs_of("paper", n_nodes=100.0)
    runs.loc[runs["level"] > 0.1, ["outcome", "n_nodes"]] = "limited", 50.0
    assert judged(evidence(runs), {**TREND, "quantities": ["n_nodes"]}).verdict == REPRODUCED


def test_a_rise_is_sought_between_levels_within_a_factor():
    """The error may already be large at the last level but one."""

    def verdict(errors: tuple[float, ...], first: float, **more: float) -> str:
        sizes = dict(zip(LEVELS, errors, strict=True))
        runs = runs_of("rival", rmse=lambda level, draw: draw * sizes[level])
        runs["level"] += first
        return judged(evidence(runs), {**RISE, **more}).verdict

    early, gradual = (0.02, 0.4, 0.45), (0.05, 0.12, 0.25)
    assert verdict(early, 0.1) == verdict(early, 0.1, within=2) == REPRODUCED
    assert verdict(gradual, 0.1) == REPRODUCED
    assert verdict(gradual, 0.1, within=2) == NOT  # between 0.1 and 0.2, and between 0.2 and 0.3
    assert verdict(gradual, 0.2, within=2) == REPRODUCED  # between 0.2 and 0.4


def with_rotation(method: str, translation: float, total: float, **columns) -> pd.DataFrame:
    """Runs in 3D that end with a rotation stage."""
    extra = {
        "time_s_translation": translation,
        "n_nodes_translation": 10,
        "is_optimal_translation": 1,
    }
    return runs_of(method, time_solve_s=total, extra=json.dumps(extra), **columns)


@pytest.mark.parametrize(
    ("translation", "total", "verdict"),
    [(3.0, 5.0, REPRODUCED), (0.2, 0.4, NOT), (0.2, 5.0, OPEN)],
)
def test_a_time_verdict_holds_with_and_without_the_reconstructed_rotation(
    translation, total, verdict
):
    check = {**TIME, "claimed": {"above": 1.0}}
    ours, rival = with_rotation("paper", translation, total), runs_of("rival", time_solve_s=1.0)
    found = judged(evidence(ours, rival), check)
    assert found.verdict == verdict
    assert ("rotation stage, which is a reconstruction" in found.reason) == (verdict == OPEN)
    swapped = {**check, "subject": "rpm_htb", "rivals": ["dcreg_paper"], "claimed": {"below": 1.0}}
    assert judged(evidence(ours, rival), swapped).verdict == verdict


@pytest.mark.parametrize("quantity", ["time", "translation_time"])
@pytest.mark.parametrize(
    ("seconds", "verdict"), [(1.9, OPEN), (2.1, REPRODUCED), (0.6, OPEN), (0.4, NOT)]
)
def test_times_of_different_days_decide_only_beyond_their_spread(seconds, verdict, quantity):
    check = {**TIME, "quantity": quantity, "claimed": {"above": 1.0}}
    tables = runs_of("paper", time_solve_s=seconds), runs_of("rival", time_solve_s=1.0)
    found = judged(evidence(*tables), check)
    assert found.verdict == verdict
    assert ("differ between days" in found.reason) == (verdict == OPEN)
    if verdict == OPEN:  # more trials do not help
        assert {each.needed for row in found.rows for each in row.decided} == {None}


@pytest.mark.parametrize(("seconds", "needs"), [(0.9, False), (1.5, True)])
def test_more_trials_are_needed_only_where_they_can_decide(seconds, needs):
    """Beyond the differences between days, an interval that is too wide becomes narrower."""
    check = {**TIME, "claimed": {"above": 1.0}}
    wide = runs_of("paper", time_solve_s=lambda level, draw: seconds * draw**8)
    found = judged(evidence(wide, runs_of("rival", time_solve_s=1.0)), check)
    assert found.verdict == OPEN
    assert ("needs" in found.reason) == needs
    assert ("differ between days" in found.reason) != needs


@pytest.mark.parametrize(("factor", "verdict"), [(0.3, OPEN), (0.1, REPRODUCED), (3.0, NOT)])
def test_factors_of_times_decide_only_beyond_the_differences_of_both(factor, verdict):
    check = {**SENSITIVITY, "quantities": ["translation_time"]}
    seconds = {"half": 1.0, "paper": 1.0, "pa": 1.0 / factor, "rival": 1.0}
    if factor > 1.0:
        seconds |= {"half": factor, "pa": 1.0}
    found = judged(evidence(*(runs_of(name, time_solve_s=s) for name, s in seconds.items())), check)
    assert found.verdict == verdict


def test_a_test_without_a_value_is_missing():
    check = {**VALUE, "quantity": "violation", "statistic": "maximum", "claimed": {"at_most": 0}}
    runs = runs_of("paper")
    assert judged(evidence(runs), check).verdict == REPRODUCED
    none = runs.assign(test="deformation", lower_bound=0.0, run_id="d" + runs["run_id"])
    found = judged(evidence(pd.concat([runs, none], ignore_index=True)), check)
    assert found.verdict == OPEN
    assert "contradicted lower bound of" in found.reason


def test_bounds_of_other_objectives_are_not_refuted():
    runs = runs_of("paper", lower_bound=2.0)
    assert is_refuted(runs).all()
    assert not is_refuted(runs.assign(certificate_scope="rotation for this translation")).any()


def test_a_known_better_pose_is_missed_only_beyond_the_tolerance_of_an_optimum():
    kinds = {"within": {"gap_tol": 0.6}, "beyond": {"gap_tol": 0.4}}
    kinds["at a limit"] = {**kinds["beyond"], "status": "time_limit"}
    found = {
        name: evidence(runs_of("paper", upper_bound=1.5, objective_best=1.0, **columns))
        .experiments["paper2d"].runs["missed"]
        for name, columns in kinds.items()
    }  # fmt: skip
    assert (found["within"] == 0).all()
    assert (found["beyond"] == 1).all()
    assert found["at a limit"].isna().all()


def test_a_bound_of_zero_proves_nothing():
    runs = evidence(runs_of("paper", lower_bound=0.0)).experiments["paper2d"].runs
    assert runs["violation"].isna().all()


def test_a_rotation_at_the_limit_does_not_cut_the_translation_search():
    check = {**RATIO, "quantity": "translation_time", "claimed": {"below": 1.0}}
    ours = with_rotation("paper", 0.2, 10.0, outcome="limited")
    rival = with_rotation("rival", 3.0, 10.0, outcome="limited")
    assert figures(check, ours, rival) == [(pytest.approx(0.2 / 3), TRIALS)] * 3
    assert judged(evidence(ours, rival), check).verdict == REPRODUCED
    check = {**check, "quantity": "time"}
    assert judged(evidence(ours, rival), check).verdict == OPEN


def test_a_method_that_gives_up_early_counts_its_own_time():
    runs = runs_of("paper", time_solve_s=0.01, outcome="failed", rmse=np.nan)
    assert set(evidence(runs).experiments["paper2d"].runs["time"]) == {0.01}


def test_wrong_poses_at_a_limit_leave_a_rate_open_on_one_side():
    """More time can make a wrong pose right; what it does to the errors is not known."""
    table = pd.DataFrame({"success": [1.0, 0.0, 1.0], "limited": [True, False, False]})
    table["search_error"] = 1.0 - table["success"]
    wrong = table.assign(limited=[False, True, False])
    assert limits("success", table) == {"rises": False}
    assert limits("success", wrong) == {"rises": True}
    assert limits("search_error", table) == {"falls": False}
    assert limits("search_error", wrong) == {"falls": True}
    assert limits("error", wrong) == {}


def test_no_wrong_pose_at_a_limit_refutes_a_success_rate(monkeypatch):
    source = Source.__new__(Source)
    runs = pd.DataFrame(
        {"success": [0.0] * 40, "limited": True, "method": "name", "test": "noise", "level": 0.1,
         "unit": range(40), "instance_id": range(40),
         "run_id": [str(number) for number in range(40)]}
    )  # fmt: skip
    settings = {"methods": ["any"], "quantity": "success", "claimed": {"at_least": 0.9}}
    monkeypatch.setattr(Source, "runs", lambda *_: [("name", runs)])
    (part,) = CHECKS["value"](source, settings).parts
    assert part.rises
    monkeypatch.setattr(Source, "runs", lambda *_: [("name", runs.assign(limited=False))])
    (part,) = CHECKS["value"](source, settings).parts
    assert not part.rises
