"""Cards whose parameters their loader cannot have are refused, and stop no other dataset."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from data import __main__ as commands
from data.contract import Card, DataError
from data.loaders import STOCK
from data.registry import HERE, Found, datasets, read_card
from workflows import grid
from workflows.grid import DatasetSettings

FILE = {"path": "a/b.ply", "sha256": "0" * 64}
GOOD = {
    "points": {"shapes": {"a": {"file": "a/b.ply"}}},
    "scan_pair": {
        "shape": "street", "source": "a/b.ply", "target": "a/b.ply", "transform": "a/b.ply",
        "voxel": 0.5, "tolerance": 1.5, "n_points": 200,
    },
    "photographs": {
        "folder": "V", "layout": "voc", "shapes": ["car"], "n_trials": 2, "n_points": 50, "sigma": 3,
    },
    "pairs": {"folder": ".", "tolerance": 0.1},
}  # fmt: skip
REQUIRED = [(loader, key) for loader, given in GOOD.items() for key in given]


def built(loader: str, parameters: dict) -> None:
    card = Card(
        name="mine", dim=3, licence="l", citation="c", loader=loader, files=[FILE],
        parameters=parameters,
    )  # fmt: skip
    STOCK[loader](card)


def test_every_stock_loader_is_tested_here():
    assert set(GOOD) == set(STOCK)


@pytest.mark.parametrize("loader", GOOD)
def test_a_card_with_all_parameters_is_taken_and_one_with_more_is_not(loader):
    built(loader, GOOD[loader])
    with pytest.raises(DataError, match=r"^data/mine/card\.yaml: parameters\.size: unknown"):
        built(loader, {**GOOD[loader], "size": 1})


@pytest.mark.parametrize(("loader", "key"), REQUIRED)
def test_a_missing_parameter_is_named(loader, key):
    fewer = {name: value for name, value in GOOD[loader].items() if name != key}
    with pytest.raises(
        DataError, match=rf"^data/mine/card\.yaml: parameters\.{key}: missing; add it"
    ):
        built(loader, fewer)


@pytest.mark.parametrize(
    ("loader", "key", "value", "expected"),
    [
        ("points", "shapes", {}, r"shapes: \{\}; "),
        ("points", "shapes", ["a"], r"shapes: \['a'\]; "),
        ("points", "shapes", {"a": {}}, r"shapes\.a\.file: missing; add it"),
        ("points", "shapes", {"a": {"file": "a/c.ply"}},
         r"shapes\.a\.file: 'a/c\.ply' is not among the files of the card; did you mean 'a/b\.ply'"),
        ("points", "shapes", {"a": {"file": "a/b.ply", "skip_rows": -1}}, r"shapes\.a\.skip_rows: -1; "),
        ("scan_pair", "target", "t.ply", r"target: 't\.ply' is not among the files of the card"),
        ("scan_pair", "voxel", 0, "voxel: 0; input should be greater than 0"),
        ("scan_pair", "tolerance", True, "tolerance: True; input should be a valid number"),
        ("scan_pair", "n_points", 2, "n_points: 2; input should be greater than or equal to 3"),
        ("photographs", "layout", "coco", "layout: 'coco'; input should be 'voc' or 'caltech'"),
        ("photographs", "sigma", float("nan"), "sigma: nan; "),
        ("photographs", "n_trials", 0, "n_trials: 0; "),
        ("pairs", "tolerance", 0, "tolerance: 0; input should be greater than 0"),
        ("pairs", "n_points", 1, "n_points: 1; input should be greater than or equal to 3"),
        ("pairs", "scale_range", [2, 1],
         r"scale_range: \[2\.0, 1\.0\]; give two numbers, 0 < low <= high"),
    ],
)  # fmt: skip
def test_a_value_that_cannot_be_is_named(loader, key, value, expected):
    with pytest.raises(DataError, match=rf"^data/mine/card\.yaml: parameters\.{expected}"):
        built(loader, {**GOOD[loader], key: value})


def test_a_wrong_card_stops_only_those_who_ask_for_it(tmp_path, monkeypatch):
    for name, folder in (("good", "."), ("bad", 5)):
        (tmp_path / name).mkdir()
        text = (
            f"name: {name}\ndim: 3\nloader: pairs\nparameters: {{folder: {folder}, tolerance: 1}}\n"
        )
        (tmp_path / name / "card.yaml").write_text(text)
    found = Found(tmp_path)
    assert sorted(found) == ["bad", "good"]
    assert len(found) == 2
    assert found["good"] is found["good"]
    assert "bad" in found
    assert "other" not in found
    monkeypatch.setattr("data.registry.datasets", lambda: found)
    asked = DatasetSettings(dataset="bad", tests={"pair": [0]})
    (problem,) = grid.check_datasets([asked])
    place = tmp_path / "bad" / "card.yaml"
    assert problem.startswith(f"datasets[0].dataset: {place}: parameters.folder: 5; ")


def test_all_cards_of_the_checkout_are_valid():
    assert {dataset.name for dataset in datasets().values()} == set(datasets())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"must be a mapping"),
        ("name: mine\n", r"dim: field required"),
        ("name: mine\ndim: 4\nloader: points\nlicence: l\ncitation: c\n", r"dim"),
        ("name: [\n", r"not valid YAML"),
    ],
)
def test_a_wrong_card_is_reported_in_one_line_with_an_example(tmp_path, text, message):
    path = tmp_path / "mine" / "card.yaml"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(
        DataError, match=rf"mine.card\.yaml: {message}[\s\S]*embedded/card\.yaml$"
    ) as error:
        read_card(path)
    assert "http" not in str(error.value)


def test_the_list_of_data_sets_survives_a_wrong_card(tmp_path, monkeypatch):
    for name in ("embedded", "mine"):
        (tmp_path / name).mkdir()
        text = (HERE / "embedded" / "card.yaml").read_text() if name == "embedded" else "dim: 2\n"
        (tmp_path / name / "card.yaml").write_text(text)
    monkeypatch.setattr(commands, "datasets", lambda: Found(tmp_path))
    answer = CliRunner().invoke(commands.app, ["list"])
    assert answer.exit_code == 0
    assert "error:" in answer.stdout
    assert "embedded" in answer.stdout
