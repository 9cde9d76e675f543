"""Campaigns: forecasts, the choice of the next block, and the verdicts that close a claim."""

from __future__ import annotations

import io
import math
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pandas as pd
import pytest
from rich.console import Console

from baselines import registry
from reports.campaign import campaign as campaigning
from reports.campaign import choice, forecast, growth, run
from reports.campaign import comparisons as comparing
from reports.campaign.campaign import Campaign
from reports.campaign.choice import Option, options
from reports.campaign.comparisons import comparisons
from reports.campaign.forecast import Forecast, Times, bytes_of
from reports.campaign.growth import changes
from reports.ledger.book import ledger
from reports.ledger.evidence import Evidence, plain_name
from reports.ledger.finding import Part
from reports.ledger.intervals import NOT_RUN, OPEN, REPRODUCED, Share
from reports.ledger.judging import judge
from reports.ledger.verdicts import FEW, WIDE, Decided
from reports.tables import Tables
from workflows.blocks import FORECASTS, Needs
from workflows.compose import ConfigError
from workflows.config import load
from workflows.integrity import sealed
from workflows.outcomes import STARTED
from workflows.stages.plan import expand

NAME = "paper2d-40"
EXPERIMENT = load(NAME)
NONE = Needs({})
CLAIMS = {claim.id: claim for claim in ledger().claims}


class Named(NamedTuple):
    """A judgement, as far as its verdict is concerned."""

    id: str
    verdict: str


def times(*cells: tuple[str, str, float, float]) -> Times:
    columns = ["method", "test", "level", "time_solve_s"]
    runs = pd.DataFrame(cells, columns=columns).assign(time_overhead_s=0.0)
    return Times.of([runs], EXPERIMENT)


def ahead(known: Times, needs: Needs = NONE, claim: str | None = None, done=frozenset()):
    """The options of all claims, or of one."""
    judged = judge(ledger(), Evidence({}, {}), {plain_name(NAME)})
    judged = [each for each in judged if claim in (None, each.id)]
    plan = expand(EXPERIMENT, None, NAME, needs)
    return options(ledger(), judged, plan, known, 100, done)


@pytest.fixture(scope="module")
def unseen():
    """The options where no run is known."""
    return ahead(times())


def test_an_unseen_method_is_expected_to_take_as_long_as_others_of_its_baseline():
    known = times(("dcreg-paper", "noise", 0.02, 3.0), ("dcreg-paper", "noise", 0.04, 5.0))
    assert known.of_cell("dcreg-paper-half", "noise", 0.03) == (4.0, False)
    assert known.of_cell("dcreg-paper-half", "deformation", 0.03)[0] > 50.0
    assert known.of_cell("rpm_pa", "noise", 0.03)[0] > 50.0


def test_a_measured_cell_is_expected_to_take_its_mean():
    known = times(("rpm_pa", "noise", 0.02, 1.0), ("rpm_pa", "noise", 0.02, 3.0))
    assert known.of_cell("rpm_pa", "noise", 0.02) == (2.0, True)


def test_unseen_cells_use_their_test_then_the_method_then_the_limit():
    known = times(("rpm_pa", "noise", 0.05, 9.0), ("rpm_pa", "noise", 0.02, 4.0))
    assert known.of_cell("rpm_pa", "noise", 0.032) == (pytest.approx(6.0), False)
    assert known.of_cell("rpm_pa", "noise", 0.01) == (4.0, False)
    assert known.of_cell("rpm_pa", "noise", 0.06) == (9.0, False)
    limit = known.limits["rpm_pa"]
    assert known.of_cell("rpm_pa", "deformation", 0.0) == ((6.5 * limit) ** 0.5, False)
    assert known.of_cell("rpm_cav", "noise", 0.02) == (known.limits["rpm_cav"], False)


def test_a_method_without_runs_is_expected_by_those_of_other_experiments(tmp_path, monkeypatch):
    campaign = Campaign(NAME, tmp_path)
    monkeypatch.setattr(campaigning, "runs_of", lambda name: None)
    monkeypatch.setattr(campaigning, "runs_of_others", lambda name: None)
    limit = campaign.times().limits["rpm_pa"]
    assert campaign.times().of_cell("rpm_pa", "noise", 0.02) == (limit, False)
    other = pd.DataFrame(
        {"experiment": ["mine"], "method": "rpm_pa", "test": "noise", "level": 0.02,
         "time_solve_s": 2.0, "time_overhead_s": 0.0, "machine_id": "there"}
    )  # fmt: skip
    monkeypatch.setattr(campaigning, "runs_of_others", lambda name: other)
    assert campaign.times().of_cell("rpm_pa", "noise", 0.02) == ((2.0 * limit) ** 0.5, False)


def test_times_of_this_machine_come_before_those_of_others(tmp_path, monkeypatch):
    monkeypatch.setattr(campaigning, "machine_card", lambda: {"machine_id": "here"})
    monkeypatch.setattr(campaigning, "runs_of_others", lambda name: None)
    runs = pd.DataFrame(
        {"method": "rpm_pa", "test": "noise", "level": [0.02, 0.02, 0.03], "time_overhead_s": 0.0,
         "time_solve_s": [9.0, 2.0, 7.0], "machine_id": ["there", "here", "there"]}
    )  # fmt: skip
    monkeypatch.setattr(campaigning, "runs_of", lambda name: runs)
    times = Campaign(NAME, tmp_path).times()
    assert times.of_cell("rpm_pa", "noise", 0.02) == (2.0, True)
    assert times.of_cell("rpm_pa", "noise", 0.03) == (7.0, True)


def test_runs_of_the_quick_part_at_a_limit_take_the_limit_of_the_experiment():
    runs = pd.DataFrame(
        {"method": ["rpm_pa"] * 2, "outcome": ["limited", "finished"], "time_solve_s": [1.0, 2.0]}
    )
    limit = EXPERIMENT.limits_of(EXPERIMENT.method("rpm_pa")).time_s
    assert list(Times.as_limited(runs, EXPERIMENT)["time_solve_s"]) == [limit, 2.0]


def test_disk_is_forecast_from_the_bytes_per_run(tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "a.parquet").write_bytes(bytes(3000))
    (tmp_path / "plan.parquet").write_bytes(bytes(1000))
    known = Times.of([], EXPERIMENT, bytes_of(tmp_path) / 4)
    plan = expand(EXPERIMENT, None, NAME, Needs({"noise": {"rpm_pa": 1}}))
    found = known.of_runs(plan.runs())
    assert found.megabytes == pytest.approx(found.runs * 1000 / 1e6)
    assert "MB" in str(found)
    assert "MB" not in str(Forecast(1, 2.0, 1))


def test_methods_that_are_not_installed_take_no_time(monkeypatch):
    monkeypatch.setattr(forecast, "runs_here", lambda method: method.name != "rpm_pa")
    plan = expand(EXPERIMENT, None, NAME, Needs({"noise": {"rpm_pa": 1, "rpm_cav": 1}}))
    found, limit = times().of_runs(plan.runs()), times().limits["rpm_cav"]
    assert found.runs == 2 * found.unseen
    assert found.seconds == found.unseen * limit
    assert found.unmeasured == {("rpm_cav", "noise"): found.unseen * limit}


@pytest.fixture
def costly():
    """An option."""
    step = Forecast(24, 5000.0, 12)
    return Option("claim", None, NONE, step, step, 1, step.seconds)


@pytest.mark.parametrize("left_s", [1.0, 10000.0])
def test_the_next_step_does_not_depend_on_the_time_left(costly, left_s):
    short = replace(costly, claim="short", step=replace(costly.step, seconds=100.0))
    none = replace(costly, claim="none", step=replace(costly.step, seconds=1.0), helps=False)
    ahead = [(NAME, none), (NAME, costly), (NAME, short)]
    assert run._next(ahead, left_s) == (NAME, costly)
    assert run._next(ahead, 0.0) is None
    assert run._next(ahead[:1], left_s) is None


def test_runs_of_an_interrupted_block_are_measured_and_done(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_ARCHIVES", "")
    campaign = Campaign(NAME, tmp_path)
    Needs({"noise": {"rpm_pa": 1}}).write(campaign.needs_path)
    planned = list(campaign.plan().runs())
    row = {"run_id": planned[0].run_id, "instance_id": planned[0].instance.instance_id,
           "instance_digest": "", "fingerprint": registry.fingerprint("rpm_pa"),
           "time_solve_s": 3.0, "time_overhead_s": 1.0, "status": "optimal",
           "machine_id": "here"}  # fmt: skip
    path = tmp_path / "results" / NAME / "runs" / "rpm_pa" / "2d-00-000000.journal.jsonl"
    path.parent.mkdir(parents=True)
    other = {**row, "run_id": "other", "time_solve_s": 100.0}  # with another limit
    old = {**row, "fingerprint": "rpm_pa 0", "time_solve_s": 100.0}
    path.write_text("".join(f"{sealed(each)}\n" for each in (row, other, old)))
    assert campaign.ended()["run_id"].tolist() == [planned[0].run_id]
    spec = planned[0].instance
    assert campaign.times().of_cell("rpm_pa", spec.test, spec.level) == (4.0, True)
    assert campaign.forecast(campaign.plan()).runs == len(planned) - 1


def test_ended_runs_are_not_shown_before_their_tables_are_made(tmp_path, monkeypatch):
    """As after an interruption between the last run of a block and its tables."""
    monkeypatch.setenv("DCREG_ARCHIVES", "")
    campaign = Campaign(NAME, tmp_path)
    assert not campaign.is_behind()
    Needs({"noise": {"rpm_pa": 1}}).write(campaign.needs_path)
    runs = pd.DataFrame({"run_id": [each.run_id for each in campaign.plan().runs()]}).assign(
        method="rpm_pa", outcome="finished", fingerprint=registry.fingerprint("rpm_pa"),
        test="noise", level=0.0, time_solve_s=1.0, time_overhead_s=0.0, machine_id="here",
    )  # fmt: skip
    monkeypatch.setattr(Campaign, "ended", lambda self: runs)
    assert campaign.is_behind()
    assert not campaign.forecast(campaign.plan()).runs
    for columns, is_behind in [
        ({}, False), ({"outcome": "not_needed"}, True), ({"fingerprint": "rpm_pa 0"}, True),
    ]:  # fmt: skip
        tables = Tables(tmp_path, runs.assign(**columns), pd.DataFrame(), {}, [])
        monkeypatch.setattr(Campaign, "tables", lambda self, tables=tables: tables)
        assert campaign.is_behind() == is_behind


def test_every_claim_about_the_experiment_has_a_next_block(unseen):
    judged = {claim.id for claim in ledger().claims if claim.experiment == "paper2d"}
    assert {option.claim for option in unseen} == judged
    for option in unseen:
        assert option.block.runs > 0
        assert not option.obstacle


def test_a_block_has_the_methods_of_one_comparison_and_no_others(unseen):
    low = next(option for option in unseen if option.claim == "low-inlier")
    ((test, levels),) = low.comparison.tests
    assert (test, levels) in {("mixed_outliers", (1.0, 2.0)), ("separate_outliers", (1.0,))}
    (method,) = low.comparison.methods
    assert EXPERIMENT.method(method).baseline == "dcreg_paper"
    needed = low.needs.trials[test]
    assert list(low.needs.trials) == [test]
    assert list(needed) == [method]
    assert needed[method].keys() == {f"{level:g}" for level in levels}
    assert len(set(needed[method].values())) == 1  # trials
    assert low.block.runs == 2 * len(levels)


def test_the_cheapest_claim_comes_first_and_the_order_does_not_depend_on_chance(unseen):
    assert [option.seconds for option in unseen] == sorted(option.seconds for option in unseen)
    assert [option.claim for option in unseen] == [option.claim for option in ahead(times())]


def test_finished_blocks_are_not_paid_again(unseen):
    first = unseen[0]
    (again,) = ahead(times(), first.needs, first.claim)
    assert again.block.runs == first.block.runs  # one more trial, without the one before
    for test, own in first.needs.trials.items():
        more = {name: dict.fromkeys(levels, 2) for name, levels in own.items()}
        assert again.needs.trials[test] == more


@pytest.mark.parametrize("claim", ["robust-extreme", "occl-stable"])
def test_the_runs_of_further_blocks_are_those_that_a_whole_plan_adds(claim):
    first = comparisons(ledger(), CLAIMS[claim], expand(EXPERIMENT, None, NAME, NONE))[0]
    plan = expand(EXPERIMENT, None, NAME, first.more(NONE, 1))
    state = choice._State(plan, times(), 100, frozenset())
    needs, runs = state.ahead({first: 2})
    whole = {run.run_id for run in expand(EXPERIMENT, None, NAME, needs).runs()}
    before = {run.run_id for run in plan.runs()}
    assert before < whole
    assert {run.run_id for run in runs} == whole - before


def test_the_runs_of_a_pilot_are_not_forecast_again(unseen):
    first = unseen[0]
    done = {next(expand(EXPERIMENT, None, NAME, first.needs).runs()).run_id}
    (again,) = ahead(times(), claim=first.claim, done=done)
    assert again.needs == first.needs
    assert again.block == first.block
    assert again.step.runs == first.step.runs - len(done)


def test_a_block_is_one_trial_also_of_methods_that_other_claims_left_out():
    """They need not run all trials that another claim needed of one method."""
    (first,) = ahead(times(), claim="faster")
    test, own = next(iter(first.needs.trials.items()))
    name = next(iter(own))
    known = Needs({test: {name: 30}})
    (option,) = ahead(times(), known, "faster")
    assert option.needs.trials[test] == {**own, name: 30}
    assert option.block.runs < first.block.runs


def test_a_claim_that_needs_more_trials_than_there_are_has_an_obstacle(unseen):
    judged = judge(ledger(), Evidence({}, {}), {plain_name(NAME)})
    plan = expand(EXPERIMENT, None, NAME, unseen[0].needs)
    found = options(ledger(), judged, plan, times(), 1)
    obstacle = "a decision needs about 10 more blocks; only 1 remain in the config"
    assert any(option.obstacle == obstacle for option in found)
    assert bool(found[-1].obstacle)


@pytest.mark.parametrize(("share", "at_once"), [(100.0, 7), (2.5, 2), (0.5, 1)])
def test_short_blocks_are_run_together(monkeypatch, share, at_once):
    monkeypatch.setattr(choice, "_unseen", lambda *_: (7, ""))

    def low_inlier():
        (option,) = ahead(times(), claim="low-inlier")
        return option

    monkeypatch.setattr(choice, "STEP_S", share * low_inlier().block.seconds)
    found = low_inlier()
    numbers = [n for own in found.needs.trials.values() for by in own.values() for n in by.values()]
    assert set(numbers) == {at_once}
    assert found.step.runs == at_once * found.block.runs
    assert found.blocks == 7


@pytest.mark.parametrize(
    ("claim", "blocks"),
    [
        ("low-inlier", 33),  # two shapes; 66 right poses of 66 show that a rate is at least 0.9
        ("occl-stable", 10),
        ("faster", 10),  # all levels of two shapes
        ("bound-explains", 10),
        ("half-occl", 10),  # a comparison per level
    ],
)
def test_claims_without_runs_need_the_minimum_number_of_trials(unseen, claim, blocks):
    assert next(option for option in unseen if option.claim == claim).blocks == blocks


RIGID = "paper3d-40"


def part(*methods: str, claimed: dict, estimate, levels=(0.01, 0.02, 0.03, 0.04, 0.05), **fields):
    """A figure about deformation."""
    cells = frozenset(("deformation", level) for level in levels)
    return Part("a", "b", "c", "", estimate, claimed, methods=methods, cells=cells, **fields)


def option_of(claim: str, needs: Needs, *decided: tuple[int, Decided], trials: int = 100) -> Option:
    """The option of an open claim about the 3D tests with these decisions, each of a check."""
    rows = tuple(SimpleNamespace(check=check, decided=(each,)) for check, each in decided)
    judged = SimpleNamespace(id=claim, verdict=OPEN, rows=rows, reason="why")
    plan = expand(load(RIGID), None, RIGID, needs)
    (option,) = options(ledger(), [judged], plan, Times.of([], load(RIGID)), trials)
    return option


def nonrigid(value: float, n: int = 10, verdict: str = OPEN, **fields) -> Option:
    """The option of a claim, one of whose rivals has a success rate; claimed is less than 0.5."""
    rival = part("goicp-all", claimed={"below": 0.5}, estimate=Share(value, n), **fields)
    needs = Needs({"deformation": {"goicp-all": 1}})
    return option_of("nonrigid", needs, (1, Decided(rival, verdict, 0.01, FEW)))


def test_a_comparison_that_is_expected_to_refute_its_claim_is_enough():
    option = nonrigid(0.7)
    assert option.comparison.methods == ("goicp-all",)
    assert option.seconds == option.blocks * option.block.seconds
    assert option.blocks == math.ceil(Share(0.7, 10).needed(0.5, 0.01) / 10) - 1


@pytest.mark.parametrize(
    "case",
    [{"value": 0.3}, {"cannot_refute": "why"}, {"falls": True}, {"n": 4}, {"verdict": REPRODUCED}],
)
def test_otherwise_all_comparisons_of_a_claim_take_their_time(case):
    option = nonrigid(**{"value": 0.7, **case})
    assert option.seconds > 3 * option.blocks * option.block.seconds
    assert (option.comparison.methods == ("goicp-all",)) <= (case != {"verdict": REPRODUCED})


def test_a_comparison_with_an_obstacle_does_not_stop_those_that_could_refute_the_claim():
    late = nonrigid(0.3, n=40)
    assert (late.obstacle, late.helps) == ("", True)
    wide = part("goicp-all", claimed={"below": 0.5}, estimate=Share(0.499, 40))
    needs = Needs({"deformation": {"goicp-all": 4}})
    option = option_of("nonrigid", needs, (1, Decided(wide, OPEN, 0.01, WIDE)))
    assert option.obstacle.startswith("the effect is so small")
    assert option.helps
    assert option.comparison.methods != ("goicp-all",)
    assert sorted([option, late], key=lambda each: each.rank) == [late, option]


def test_methods_that_differ_by_a_choice_of_ours_refute_a_claim_together():
    """FRS with and without a refinement of its pose."""
    needs = Needs({"deformation": {"frs": 1, "frs-plain": 1}})
    figures = [
        (1, Decided(part(name, claimed={"below": 0.5}, estimate=Share(value, 10)), OPEN, 0.01, FEW))
        for name, value in (("frs", 0.9), ("frs-plain", 0.1))
    ]
    one = option_of("nonrigid", needs, *figures)
    both = option_of("nonrigid", needs, figures[0], (1, replace(figures[1][1], part=replace(
        figures[1][1].part, estimate=Share(0.9, 10)))))  # fmt: skip
    assert both.comparison.methods == ("frs", "frs-plain")
    assert both.seconds < one.seconds


def test_a_variant_without_runs_is_run_before_longer_comparisons_that_could_refute():
    needs = Needs({"deformation": {"frs": 1, "goicp-all": 1}})
    figures = [
        (1, Decided(part(name, claimed={"below": 0.5}, estimate=Share(0.9, 10)), OPEN, 0.01, why))
        for name, why in (("frs", "not all variants of FRS agree"), ("goicp-all", FEW))
    ]
    plan = expand(load(RIGID), None, RIGID, needs)
    times = Times.of([], load(RIGID))
    own = [
        each for each in comparisons(ledger(), CLAIMS["nonrigid"], plan) if "frs" in each.methods
    ]
    assert own[0].blocks_in(needs) == 0
    found = choice._opened(own[0], [figures[0][1]], choice._State(plan, times, 100, set()))
    assert (found.refutes, found.blocks, found.obstacle) == (True, own[0].least, "")


def test_blocks_of_other_levels_do_not_count_for_a_figure():
    """Level 0.3 was run for another claim as well."""
    needs = Needs({"mixed_outliers": {"dcreg-paper": {"1": 20, "2": 2}}})
    figures = {
        level: Decided(
            Part("a", "b", "c", "", Share(0.95, n), {"at_least": 0.9}, methods=("dcreg-paper",),
                 cells=frozenset({("mixed_outliers", level)})), OPEN, 0.01, WIDE)
        for level, n in ((1.0, 40), (2.0, 4))
    }  # fmt: skip
    plan = expand(EXPERIMENT, None, NAME, needs)
    (own, *_) = comparisons(ledger(), CLAIMS["low-inlier"], plan)
    alone = {level: choice._blocks(own, [each], needs)[0] for level, each in figures.items()}
    wanted = figures[1.0].needed
    assert alone[1.0] == math.ceil(wanted / 2) - 20
    assert choice._blocks(own, list(figures.values()), needs)[0] == max(alone.values())


def test_figures_of_another_comparison_do_not_count():
    """Those of a method alone are no figures of its comparison with a rival."""
    alone = part("dcreg-paper", claimed={"at_most": 1.01}, estimate=Share(0.5, 40))
    option = option_of("low-3d", NONE, (0, Decided(alone, REPRODUCED, 0.01)))
    first = option_of("low-3d", NONE)
    assert (option.seconds, option.comparison) == (first.seconds, first.comparison)


def test_runs_without_a_figure_are_an_obstacle():
    needs = Needs({"deformation": {"goicp-all": 10, "dcreg-paper": 10}})
    option = option_of("low-3d", needs)
    assert (
        option.obstacle == "the runs so far give no value for this comparison (see their statuses)"
    )
    assert option.helps


def test_one_figure_on_the_claimed_side_is_enough_for_a_check_of_any():
    gore = Part(
        "a", "b", "c", "", Share(1.0, 40), {"above": 1.0},
        methods=("dcreg-paper", "gore-norm-signature"), cells=frozenset({("separate_outliers", 0.5)}),
    )  # fmt: skip
    before = option_of("separate-3d", NONE)
    option = option_of("separate-3d", NONE, (1, Decided(gore, REPRODUCED, 0.01)))
    assert option.seconds < before.seconds
    assert option.comparison.check == 0
    wrong = Decided(replace(gore, estimate=Share(0.0, 40)), OPEN, 0.01, WIDE)
    assert (
        option_of("separate-3d", NONE, (1, wrong)).seconds > option.seconds
    )  # refuted by all only


def test_a_claim_that_is_open_for_another_reason_states_it():
    (claim,) = (each for each in ledger().claims if each.id == "half-time")
    own = comparisons(ledger(), claim, expand(load(RIGID), None, RIGID, NONE))
    figures = [
        (0, Decided(Part("a", "b", "c", "", Share(1.0, 40), {"within": [0.8, 1.25]},
                         methods=each.methods, cells=each.figures[0].cells), REPRODUCED, 0.01))
        for each in own
    ]  # fmt: skip
    option = option_of("half-time", NONE, *figures)
    assert (option.obstacle, option.helps) == ("why", False)


def test_an_experiment_without_a_list_of_shapes_has_no_blocks(tmp_path):
    with pytest.raises(
        ConfigError, match="--experiments threedmatch: dataset threedmatch has no list"
    ):
        run.collect(0.0, ["threedmatch"], tmp_path, 1, tmp_path / "out")


def test_methods_that_are_not_installed_are_not_compared(monkeypatch):
    monkeypatch.setattr(comparing, "runs_here", lambda method: method.name != "rpm_pa")
    claim = next(each for each in ledger().claims if each.id == "faster")
    found = comparisons(ledger(), claim, expand(EXPERIMENT, None, NAME, NONE))
    names = {name for each in found for name in each.methods}
    assert names
    assert "rpm_pa" not in names


@pytest.mark.parametrize(
    ("claim", "number"),
    [
        ("low-inlier", 3),
        ("low-def", 6),  # levels
        ("time-easy", 2 * 6 + 2),
        ("time-hard", 3 * 2),  # tests, time and boxes
        ("eps-min", 5 * 2 + 5),  # tests, both priors
        ("robust-extreme", 5 * 4),  # top levels of the tests; RPM-HTB has two variants
        ("half-occl", 3 * 4),
        ("occl-stable", 4 + 4),
        ("bound-explains", 5 + 1),
    ],
)
def test_all_comparisons_of_a_claim_are_planned(claim, number):
    (found,) = (each for each in ledger().claims if each.id == claim)
    planned = comparisons(ledger(), found, expand(EXPERIMENT, None, NAME, NONE))
    assert sum(figure.number for each in planned for figure in each.figures) == number


def test_a_block_has_only_the_levels_that_its_claim_compares():
    claim = next(each for each in ledger().claims if each.id == "sharp-003")
    found = comparisons(ledger(), claim, expand(EXPERIMENT, None, NAME, NONE))
    assert {each.tests for each in found} == {(("noise", (0.03, 0.05)),)}


def test_a_campaign_continues_from_the_blocks_and_tables_of_an_archive(tmp_path, monkeypatch):
    archives, needs = tmp_path / "archives", Needs({"noise": {"dcreg": 1, "rpm_pa": 1}})
    for number, stored in enumerate([NONE, needs]):
        folder = archives / str(number)
        needs_path = folder / "experiments" / NAME / "needs.json"
        stored.write(needs_path)
        (folder / "archive.json").write_text(f'{{"created": "{number}"}}')

    def restored(archive, out, only):
        tables = out / only / "tables"
        tables.mkdir(parents=True)
        (tables / "origin").write_text(archive.name)
        return [tables]

    monkeypatch.setattr(campaigning, "restore", restored)
    monkeypatch.setenv("DCREG_ARCHIVES", str(archives))
    campaign = Campaign(NAME, tmp_path)
    campaign.adopt()
    assert Needs.read(campaign.needs_path) == needs
    assert (campaign.folder / "tables" / "origin").read_text() == "1"
    assert [path.name for path in campaign.folder.iterdir()].count("tables") == 1
    more = needs.with_block("noise", ["dcreg"], [0.01])
    more.write(campaign.needs_path)
    campaign.adopt()
    assert Needs.read(campaign.needs_path) == more


def test_a_block_shows_the_state_of_its_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_ARCHIVES", "")  # whose many runs would be read
    views = []

    def snakemake(directory, name, arguments, view_of, end, plan):
        views.append(view_of())
        (campaign.folder.parent / "made").write_bytes(bytes(3_000))
        return 1

    monkeypatch.setattr(run, "run_snakemake", snakemake)
    campaign = Campaign(NAME, tmp_path)
    Needs({"noise": {"rpm_pa": 1}}).write(campaign.needs_path)
    console = Console(file=io.StringIO(), width=200)
    expected = Forecast(1, 2.0, 0)
    end = time.monotonic() + 600.0
    assert not run._run(
        campaign, "claim", expected, end=end, cores=2, out=tmp_path, console=console
    )
    count = len(list(campaign.plan().runs()))
    assert views[0].summary([]).startswith(f"0 of {count} runs ended")
    assert views[0].console is console
    log = pd.read_csv(tmp_path / FORECASTS)  # of the interrupted block
    shown = ["claim", "planned", "runs", "actual_mb"]
    assert log[shown].to_numpy().tolist() == [["claim", 1, 0, 0.003]]


def test_nothing_is_begun_once_the_time_is_over(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_ARCHIVES", "")
    monkeypatch.setattr(run, "run_snakemake", lambda *_, **__: pytest.fail("begun"))
    monkeypatch.setattr(run, "_ahead", lambda *_: [])
    Needs({"noise": {"rpm_pa": 1}}).write(Campaign(NAME, tmp_path).needs_path)
    assert run.collect(0.0, [NAME], tmp_path, 1, tmp_path / "out") == []


@pytest.mark.parametrize(("machine", "is_noted"), [("", False), ("here", False), ("there", True)])
def test_it_is_said_if_times_of_this_machine_will_not_count(machine, is_noted, monkeypatch):
    runs = pd.DataFrame({"outcome": ["finished"], "machine_id": [machine]})
    monkeypatch.setattr(Campaign, "tables", lambda self: SimpleNamespace(runs=runs))
    monkeypatch.setattr(run, "machine_card", lambda: {"machine_id": "here"})
    out = io.StringIO()
    run._note_machine(Campaign(NAME, Path()), Console(file=out))
    assert ("another machine" in out.getvalue()) == is_noted


def test_nothing_is_begun_after_an_earlier_block_was_interrupted(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_ARCHIVES", "")
    begun = []

    def interrupted(campaign, claim, *_, **__):
        begun.append((campaign.name, claim))
        return False

    monkeypatch.setattr(run, "_run", interrupted)
    monkeypatch.setattr(Campaign, "is_behind", lambda self: True)
    names = [NAME, "paper3d-40"]
    monkeypatch.setattr(run, "_ahead", lambda *_: [])
    run.collect(1.0, names, tmp_path, 1, tmp_path / "out")
    assert begun == [(NAME, "resumed")]


@pytest.mark.parametrize(("hours", "listed"), [(1.0, ["killed"]), (0.0, None)])
def test_a_call_lists_the_runs_of_a_killed_one_unless_it_only_shows(
    hours, listed, tmp_path, monkeypatch
):
    monkeypatch.setenv("DCREG_ARCHIVES", "")
    monkeypatch.setattr(run, "_run", lambda *_, **__: False)
    monkeypatch.setattr(run, "_ahead", lambda *_: [])
    monkeypatch.setattr(run, "_write", lambda *_: None)
    monkeypatch.setattr(Campaign, "ended", lambda self: pd.DataFrame({"run_id": ["killed"]}))
    run.collect(hours, [NAME], tmp_path, 1, tmp_path / "out")
    steps = tmp_path / "out" / growth.STEPS
    assert (list(pd.read_csv(steps)["run_id"]) if steps.exists() else None) == listed


def test_a_verdict_that_was_taken_back_is_named():
    table = pd.DataFrame(
        {
            1.0: ["open", "reproduced", "not run", "refuted"],
            2.0: ["reproduced", "open", "open", "refuted"],
            2.5: ["reproduced", "open", "refuted", "reproduced"],
        },
        index=["kept", "taken back", "late", "turned"],
    )
    assert changes(table) == [
        "taken back: reproduced after 1 h of runs, open after 2 h of runs",
        "turned: refuted after 1 h of runs, reproduced after 2.5 h of runs",
    ]


def test_runs_of_a_call_that_was_killed_get_a_step_in_the_next_call(tmp_path):
    steps = tmp_path / growth.STEPS
    growth.record(steps, ["a"])
    for _ in range(2):
        growth.record_rest(steps, ["b", "a", "c"])
    assert pd.read_csv(steps).to_numpy().tolist() == [["a", 0], ["b", 1], ["c", 1]]


def test_verdicts_are_those_of_the_runs_that_had_ended(monkeypatch, tmp_path):
    """The hours of both experiments count together; the first step of a run counts, or else the last."""
    steps = tmp_path / growth.STEPS
    for ended in (["a", "c"], ["b", "d"], [], ["e", "a"]):
        growth.record(steps, ended)
    tables = {
        name: Tables(
            Path(),
            pd.DataFrame(
                {"run_id": list(ids), "outcome": "finished", "time_solve_s": 1800.0,
                 "time_overhead_s": 0.0}
            ),
            pd.DataFrame(), {}, [],
        )
        for name, ids in ((NAME, "acf"), (RIGID, "bde"))
    }  # fmt: skip
    monkeypatch.setattr(growth.Evidence, "of_tables", lambda part: "".join(part.runs["run_id"]))
    monkeypatch.setattr(
        growth, "judge", lambda book, seen, names: [Named(*names, seen), Named("b", NOT_RUN)]
    )
    table = growth.verdicts(tables, steps, ledger())
    plane, space = plain_name(NAME), plain_name(RIGID)
    assert table.to_dict() == {
        1.0: {plane: "ac", space: NOT_RUN},
        2.0: {plane: "ac", space: "bd"},
        3.0: {plane: "acf", space: "bde"},
    }


def test_claims_about_other_experiments_name_their_command():
    needs = run._needs(ledger(), {}, [])
    assert set(needs["claim"]) == {claim.id for claim in ledger().claims if not claim.unjudged}
    by_claim = needs.set_index("claim")["obstacle"]
    assert by_claim["flat-7scenes"] == "outside these experiments: make threedmatch"


def test_evidence_of_other_experiments_stays_in_the_tables(tmp_path):
    """Their claims remain judged, and their runs have a step before those of new ones."""
    others = run._others([NAME], tmp_path)
    assert list(others) == ["paper3d-40"]
    campaign = others["paper3d-40"]
    started = list(run._started([campaign]))
    assert len(started) == campaign.tables().runs["outcome"].isin(STARTED).sum() > 0
    steps = tmp_path / "steps.csv"
    growth.record(steps, ["new"])
    growth.record_rest(steps, [*started, "new"])
    growth.record_rest(steps, started)
    assert pd.read_csv(steps).groupby("step").size().to_dict() == {0: 1, 1: len(started)}
    assert run._others(["paper3d-40", NAME], tmp_path) == {}
