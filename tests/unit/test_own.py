"""One's own method and data, as docs/own.md shows them, outside of the checkout."""

from __future__ import annotations

import json
import os
import re
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from baselines import check, registry
from data import fetch
from data import registry as datasets
from data.registry import read_card
from dcreg.problem import apply_pose
from reports.archive.sources import missing_code, write_readme, write_sources
from reports.archive.write import pack, write
from reports.tables import ReportError, Tables
from tests.unit import report_fixture
from workflows import UserError, config, stand_ins
from workflows.beside import needs_beside
from workflows.blocks import Needs
from workflows.config import ConfigError, with_methods
from workflows.metrics import METRICS, Case
from workflows.running import _unexplained
from workflows.stages.plan import expand, size_notes
from workflows.summary import summarise

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "own.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^```(?:python|yaml)\n# study/(\S+)\n(.*?)^```", PAGE, re.M | re.S))
MOST_LINES = 19


@pytest.fixture
def study(tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the page, with one pair of clouds."""
    for variable in (registry.SEARCH_PATH, datasets.SEARCH_PATH):
        monkeypatch.setenv(variable, "")
    for name, content in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
    place, T = tmp_path / "scans" / "desk", np.eye(4)
    T[:3, 3] = 0.01
    place.mkdir(parents=True)
    source = rng.random((400, 3))
    np.savetxt(place / "source.xyz", source)
    np.savetxt(place / "target.xyz", apply_pose(T, source))
    np.savetxt(place / "pose.txt", T)
    return tmp_path


def lines_of(*names: str) -> int:
    return sum(1 for name in names for line in FILES[name].splitlines() if line.strip())


def test_a_method_and_a_dataset_take_few_lines() -> None:
    own = [name for name in FILES if name.startswith("baselines/")]
    assert len(own) == 2
    assert lines_of(*own) <= MOST_LINES
    assert lines_of("data/my_scans/card.yaml", "mine.yaml") <= MOST_LINES


def test_the_method_of_the_page_keeps_every_rule(study: Path) -> None:
    (method,) = check.candidates(str(study / "baselines"))
    assert [result for result in check.results(method) if result[0] != check.OK] == []


def test_methods_and_datasets_next_to_a_config_are_found(study: Path) -> None:
    plan = expand(config.load(str(study / "mine.yaml")))
    assert [method.name for method in plan.methods] == ["my_method", "icp", "dcreg"]
    assert os.environ[registry.SEARCH_PATH] == str(study / "baselines")
    config.load(str(study / "mine.yaml"))
    assert os.environ[registry.SEARCH_PATH] == str(study / "baselines")
    (note,) = size_notes(plan)
    assert note.startswith("my_scans: clouds of more than 300 points are reduced to 300; to change")
    (study / "baselines" / "my_method").rename(study / "baselines" / "icp")
    with pytest.raises(
        registry.BaselineError, match="'icp' is defined twice: by baselines/icp and b"
    ):
        registry.load("icp")


def test_a_search_path_must_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(registry.SEARCH_PATH, "/no/such/place")
    with pytest.raises(
        registry.BaselineError, match="PATH: /no/such/place is not a folder; correct"
    ):
        registry.names()
    monkeypatch.setenv(datasets.SEARCH_PATH, "/no/such/place")
    with pytest.raises(datasets.DataError, match="PATH: /no/such/place is not a folder; correct"):
        datasets.datasets()


@pytest.mark.parametrize("path", ["nothing.yaml", "some/nothing"])
def test_a_missing_config_file_is_named(path: str) -> None:
    with pytest.raises(
        ConfigError, match=f"^{path}: no such config file in .*give one of all, demo"
    ):
        config.load(path)


def test_a_selection_adds_methods_to_any_experiment() -> None:
    demo = config.load("demo")
    selection = config.parse_selection(["methods=frs,icp", "tests=noise"])
    plan = expand(demo, selection)
    assert [method.name for method in plan.methods] == ["icp", "frs"]
    assert with_methods(demo, ["icp", "no_such_method"]) == demo
    wrong = config.parse_selection(["methods=frss"])
    with pytest.raises(ConfigError, match=r"METHODS=frss matches nothing; did you mean 'frs'"):
        expand(demo, wrong)
    with pytest.raises(UserError, match="nor does `make baselines` list it"):
        needs_beside(plan, ["no_such_method"], Needs({}))


def turned(degrees: float, shift: float, limits: dict[str, float]) -> bool:
    """Return whether a pose with these errors is a success."""
    points = np.random.default_rng(0).random((20, 3))
    angle, T = np.radians(degrees), np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[0, 3] = shift
    pairs = np.column_stack([np.arange(20)] * 2)
    case = Case(T, np.eye(4), points, points, pairs, 20, (1.0, 1.0), limits)
    compute = METRICS["success"].compute
    assert compute is not None
    return bool(compute(case))


def test_limits_of_the_card_decide_about_success(study: Path) -> None:
    card = read_card(study / "data" / "my_scans" / "card.yaml")
    assert card.success_limits == {"rotation_error_deg": 5.0, "translation_error": 0.1}
    assert turned(4.0, 0.05, card.success_limits)
    assert not turned(6.0, 0.05, card.success_limits)
    assert not turned(4.0, 0.2, card.success_limits)


def test_a_run_that_failed_has_no_time() -> None:
    runs = pd.DataFrame({
        "run_id": ["a", "b"], "model": "rigid3d", "test": "pair", "method": ["good", "raises"],
        "display_name": ["good", "raises"], "status": ["converged", "failed"],
        "outcome": ["finished", "failed"], "rmse": [0.1, np.nan], "success": [True, False],
        "gap": np.nan, "bound_ratio": np.nan, "time_solve_s": [2.0, 0.0001], "machine_id": "m",
        "parallel_jobs": 1.0,
    })  # fmt: skip
    times = summarise(runs).set_index("method")["median_time_s"]
    assert times["good"] == 2.0
    assert np.isnan(times["raises"])


@pytest.mark.parametrize(
    ("errors", "shown"),
    [
        ("RuleException:\nStageError in file\n`workflows x` ended with exit code 2\n", ""),
        ("StageError in file\n`workflows x` ended with exit code 1\n", None),
        ("WorkflowError: a file is missing\n", None),
    ],
)
def test_the_message_of_a_stage_is_not_followed_by_those_of_snakemake(
    errors: str, shown: str | None
) -> None:
    assert _unexplained(errors) == (errors.rstrip() if shown is None else shown)


@pytest.fixture
def no_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DCREG_DATA_CACHE", str(tmp_path))
    monkeypatch.delenv("DCREG_DATA_MIRROR", raising=False)
    monkeypatch.setattr(fetch, "_from_origin", lambda file, tried: None)


def test_without_public_data_a_quick_experiment_runs_on_embedded_shapes(
    no_network: None, capsys: pytest.CaptureFixture
) -> None:
    name, select, plan = stand_ins.fetchable("paper2d-quick", ["methods=icp", "shapes=fish"])
    assert (name, select) == ("paper2d-quick-embedded", ["methods=icp"])
    assert plan.experiment.name == "paper2d-quick-embedded"
    shapes = {(spec.dataset, spec.shape) for chunk in plan.chunks for spec in chunk.instances}
    assert shapes == {("embedded", "fish"), ("embedded", "glyph")}
    printed = capsys.readouterr().out
    for words in (
        "left out  lian_apm: ",
        "make report ARCHIVE=",
        "instead   the same tests on emb",
    ):
        assert words in printed


def test_without_public_data_a_long_experiment_names_the_alternative(no_network: None) -> None:
    with pytest.raises(UserError, match="embedded shapes: make run CONFIG=paper2d-embedded"):
        stand_ins.fetchable("paper2d", ["methods=icp", "trials=0"])
    with pytest.raises(UserError, match=r"paper2d_cr-quick: none of its data can be fetched here$"):
        stand_ins.fetchable("paper2d_cr-quick", ["methods=icp", "trials=0"])


def test_other_datasets_run_without_the_missing_one(no_network: None, tmp_path: Path) -> None:
    path = tmp_path / "mixed.yaml"
    path.write_text(
        "name: mixed\nmethods: [{name: icp, baseline: icp}]\ndatasets:\n"
        "  - {dataset: embedded, shapes: [fish], tests: {noise: [0.01]}}\n"
        "  - {dataset: lian_apm, shapes: [fu], tests: {noise: [0.01]}}\n"
    )
    _, select, plan = stand_ins.fetchable(str(path), [])
    assert select == ["datasets=embedded"]
    assert {spec.dataset for chunk in plan.chunks for spec in chunk.instances} == {"embedded"}


def test_an_archive_holds_config_and_code_of_ones_own_methods(study: Path) -> None:
    tables = Tables.load(report_fixture.write_tables(study / "tables"))
    config.load(str(study / "mine.yaml"))
    tables.provenance["methods"] = {
        "my_method": {"baseline": "my_method"},
        "icp": {"baseline": "icp"},
    }
    runs = tables.runs.assign(dataset="my_scans")
    secret = study / "secret.txt"
    secret.write_text("secret")
    (study / "baselines" / "my_method" / "linked.txt").symlink_to(secret)
    (study / "baselines" / "my_method" / ".env").write_text("secret")
    (study / "data" / "my_scans" / "left.ply").write_text("secret")
    out = study / "archive"
    out.mkdir()
    added = write_sources(Tables(**{**vars(tables), "runs": runs}), out)
    assert [line.partition(":")[0] for line in added] == ["my_method", "my_scans"]
    written = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert written == {
        "config.yaml", "baselines/my_method/adapter.py", "baselines/my_method/card.yaml",
        "data/my_scans/card.yaml",
    }  # fmt: skip
    write_readme({"mine": added}, {"mine": tables.provenance}, "1", out)
    assert "experiments/mine/config.yaml`\n  - my_method: in `baselines/my_method`" in (
        out / "REPEAT.md"
    ).read_text(encoding="utf-8")
    assert missing_code(out) == []
    first = pack(out).read_bytes()
    assert pack(out).read_bytes() == first
    with zipfile.ZipFile(out.with_name("archive.zip")) as packed:
        assert "archive/CITATION.cff" in packed.namelist()


def test_an_archive_names_no_place_outside_of_the_checkout(study: Path) -> None:
    report_fixture.write_tables(study / "results" / "mine" / "tables")
    path = study / "results" / "mine" / "tables" / "provenance.json"
    own = str(study / "mine.yaml")
    known = json.loads(path.read_text(encoding="utf-8")) | {
        "config_file": f"../..{own}", "replay": f"make replay RESULTS=../..{study}/results RUN=",
        "commands": [f"python -m workflows run {own} --methods icp"],
        "git": {"commit": "abc", "dirty": True, "untracked": [f"data/{study.name}/patient.ply"]},
    }  # fmt: skip
    next(iter(known["methods"].values()))["origin"] = str(study / "baselines" / "my_method")
    path.write_text(json.dumps(known), encoding="utf-8")
    with pytest.raises(ReportError, match=r"version: '\.\.'"):
        write([study / "results"], study / "published" / "..", "..")
    out = write([study / "results"], study / "published" / "1", "1")
    texts = {file.name: file.read_bytes() for file in out.rglob("*.json")}
    assert not [name for name, text in texts.items() if str(study).encode() in text]
    assert b"patient.ply" not in texts["provenance.json"]
    assert b"python -m workflows run config.yaml --methods icp" in texts["archive.json"]


def test_an_archive_says_what_code_it_lacks_and_how_to_add_it(tmp_path: Path) -> None:
    tables = Tables.load(report_fixture.write_tables(tmp_path / "tables"))
    tables.provenance["methods"] = {"lost": {"baseline": "lost"}, "icp": {"baseline": "icp"}}
    runs = tables.runs.assign(dataset="embedded")
    added = write_sources(Tables(**{**vars(tables), "runs": runs}), tmp_path)
    write_readme({"mine": added}, {"mine": tables.provenance}, "1", tmp_path)
    (line,) = missing_code(tmp_path)
    assert line == (
        "lost: its code is not included: unknown method 'lost'. Set DCREG_BASELINES_PATH to the folder "
        "that holds it, and publish again"
    )
