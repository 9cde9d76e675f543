"""The comparison of bounds on the same boxes: discovery, validity, reference."""

import numpy as np
import pytest

from baselines import registry
from workflows import bound_comparison as comparison

SMALL = {
    "plane": ("fish", "noise", 0.03, 10, {}),
    "space": ("pony", "noise", 0.02, 10, {}),
}


@pytest.fixture(scope="module")
def tables():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "CASES", SMALL)
        patch.setattr(comparison, "WIDTHS", np.array([1.0, 0.05]))
        yield {name: comparison.compare(name) for name in SMALL}


def test_methods_are_found_by_what_they_can_do_and_the_reference_comes_first():
    found = [(name, setting) for name, setting, _ in comparison.methods()]
    assert found[0] == comparison.REFERENCE
    assert len(set(found)) == len(found)
    able = {name for name in registry.names() if hasattr(registry.load(name), "box_bound")}
    assert {name for name, _ in found} == able
    assert {"dcreg", "rpm_htb", "rpm_bp", "hbsp"} <= able


@pytest.mark.parametrize("name", SMALL)
def test_boxes_hold_the_optimum_or_do_not(name, monkeypatch):
    monkeypatch.setattr(comparison, "CASES", SMALL)
    case = comparison.Case.of(name)
    for width in (1.0, 0.05):
        for place, boxes in comparison.boxes(case, width).items():
            for box in boxes:
                inside = ((box.lower <= case.theta) & (case.theta <= box.upper)).all()
                assert box.upper - box.lower == pytest.approx(width)
                assert place == "away from it" or inside
                assert width > 0.5 or inside == (place == "holds the optimum")


@pytest.mark.parametrize("name", SMALL)
def test_bounds_are_below_the_least_objective_met(name, tables):
    table = tables[name].dropna(subset="value")
    assert len(table)
    assert (table["value"] <= table["least"] + 1e-8).all()


def test_the_reference_loses_once_its_loss_and_first_order_bounds_more_in_small_boxes(tables):
    summary = comparison.summarise(tables["plane"])
    by_method = summary.set_index(["method", "setting", "place", "width"])["ratio"].sort_index()
    np.testing.assert_allclose(by_method.loc[comparison.REFERENCE], 1.0)
    for method, setting in (("rpm_htb", "termwise-r1"), ("rpm_bp", ""), ("hbsp", "")):
        assert by_method[method, setting, "holds the optimum", 0.05] > 2.0


def test_methods_without_a_bound_there_stay_in_the_table(tables):
    values = tables["space"].set_index("method")["value"]
    assert values["hbsp"].isna().all()
    assert values["rpm_htb"].notna().all()


def test_the_figure_is_written(tables, tmp_path):
    comparison.draw(comparison.summarise(tables["plane"]), tmp_path / "bounds")
    assert (tmp_path / "bounds.svg").stat().st_size > 1000
    assert (tmp_path / "bounds.png").stat().st_size > 1000
