"""The ledger of claims: every claim can be reproduced and can fail; roles, folders and pages."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import claim_tables
import pandas as pd
import pytest
import report_fixture
from claim_fixture import (
    JUDGED,
    PAPER,
    RATIO,
    VALUE,
    error,
    evidence,
    judged,
    runs_of,
)
from typer.testing import CliRunner

from baselines import registry
from reports.__main__ import app
from reports.claims import PAGE
from reports.ledger.book import LEDGER, Claim, Ledger, ledger, roles_of
from reports.ledger.evidence import Evidence, methods_in
from reports.ledger.intervals import MIN_TRIALS, NOT, NOT_RUN, OPEN, REPRODUCED
from reports.ledger.judging import NO_VERDICT, count, judge, judge_claim
from reports.tables import ReportError, Tables
from workflows.config import load
from workflows.stages.plan import expand, plan_table

# --- every claim -----------------------------------------------------------------------------------


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
    unjudged = [claim for claim in ledger().claims if claim.unjudged]
    assert len(ledger().claims) == 37
    assert len(unjudged) <= 4
    for claim in unjudged:
        assert claim.because
        assert all(entry["shown_only"] for entry in claim.checks)


@pytest.mark.parametrize("claim", JUDGED, ids=lambda claim: claim.id)
def test_no_quick_part_refutes_a_claim_by_few_instances_or_by_a_limit(claim, tmp_path):
    if claim.experiment == "bounds":
        pytest.skip("has no quick part")
    few = claim_tables.write(ledger(), claim, tmp_path / "few", true=False, trials=3, quick=True)
    found = judge_claim(ledger(), claim, Evidence.of_folders([few]))
    decided = [row for row in found.rows if row.verdict != OPEN]
    assert all(each.part.estimate.n >= MIN_TRIALS for row in decided for each in row.decided)
    many = claim_tables.write(ledger(), claim, tmp_path / "many", true=False, trials=12, quick=True)
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
        assert any("full experiment" in row.open_because for row in found.rows)


# --- the ledger itself -----------------------------------------------------------------------------


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
        ("unjudged: proof", "unjudged: prof", "unjudged is 'prof'"),
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
            for option in role.options:
                assert option in parameters, (role.name, baseline, option)


def test_of_each_choice_the_official_method_takes_part_before_its_port():
    fronts = ("fpfh-mutual", "norm-signature", "oracle")
    settings = [
        (f"{baseline}-{front}", baseline, {"threshold": "paper", "front_end": front}, 1.0)
        for baseline in ("teaser", "teaserpp") for front in fronts
    ]  # fmt: skip
    role = ledger().roles["teaser"]
    assert methods_in(role, settings) == ["teaserpp-norm-signature", "teaserpp-fpfh-mutual"]
    assert len(methods_in(role, settings[:3])) == role.n_choices == 2


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
    assert ledger().roles["teaser"].fit("teaser", {**options, "front_end": "oracle"}) is None


def test_claims_about_dc_reg_are_about_the_published_method():
    allowed = {"bound-explains": {"dcreg_dc"}, "no-sacrifice": {"dcreg_full"}}
    for claim in ledger().claims:
        for entry in claim.checks:
            named = {role for role in roles_of(entry) if role.startswith("dcreg")}
            ours = {role for role in named if not role.startswith("dcreg_paper")}
            assert entry.get("shown_only") or ours <= allowed.get(claim.id, set()), claim.id


# --- folders and pages -----------------------------------------------------------------------------


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
    wanted = {"half-2d": REPRODUCED, "low-3d": NOT, "tight-laps": REPRODUCED, "centre": NO_VERDICT}
    assert {name: table.loc[name, "verdict"] for name in wanted} == wanted
    for row in table[table["verdict"] == NOT_RUN].itertuples():
        assert row.reason.endswith(f": {row.command}")
    assert table[["command", "reason", "tested"]].notna().all(axis=None)
    page = (out / PAGE).read_text(encoding="utf-8")
    assert "Available tables: paper2d, paper3d, bounds." in page
    ids = re.findall(r'<article class="claim" id="([\w-]+)">', page)
    assert sorted(ids) == sorted(claim.id for claim in ledger().claims)
    for link in re.findall(r'href="([^"#]+)"', page):
        assert (out / link).is_file(), link
    data = pd.read_csv(out / "data" / "half-2d.csv")
    methods = {"dcreg_paper_half", "rpm_htb", "rpm_htb-pose", "rpm_pa", "rpm_cav"}
    assert set(data["method"]) == methods
    assert len(data) == table.loc["half-2d", "runs"]
    comparisons = pd.read_csv(out / "comparisons.csv")
    of_claim = comparisons[comparisons["claim"] == "half-2d"]
    assert len(of_claim) == 2 * 5 * 4
    assert page.count('<svg class="strip') >= of_claim.groupby(["rival", "group"]).ngroups


def test_a_verdict_against_reconstructions_says_so_in_its_first_line(written):
    page = (written / PAGE).read_text(encoding="utf-8")
    (article,) = re.findall(r'<article class="claim" id="half-2d">.*?</article>', page, re.DOTALL)
    first = re.search(r"<p>(.*?)</p>", article, re.DOTALL)[1]
    assert "not reproduced" not in first
    assert "relies on reconstructions: RPM-HTB, RPM-PA, RPM-CAV" in first


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


def test_a_claim_is_not_changed_by_what_another_one_needs():
    """Holm's correction is within a claim: its comparisons, not those of the ledger, are counted."""
    both = evidence(runs_of("paper", rmse=error(0.05)), runs_of("rival", rmse=error(0.06)))
    claim = Claim("c", "q", "t", "paper2d", (RATIO,))
    book = replace(ledger(), claims=(claim,) * 3)
    alone = judge_claim(book, claim, both)
    assert {j.rows[0].shown.level for j in judge(book, both)} == {alone.rows[0].shown.level}
