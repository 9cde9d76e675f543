"""The study of bounds: discovery, boxes, validity, orders of convergence, figures and page."""

import json

import numpy as np
import pandas as pd
import pytest

from baselines import registry
from dcreg.families.dc.bounds import IntervalBound
from dcreg.names import BOUND_NAMES
from dcreg.search import Box
from reports import bounds_study as page
from workflows import provenance
from workflows.studies import bounds as study

SMALL = {"plane": ("fish", "noise", 0.03, 10, {}), "space": ("pony", "noise", 0.02, 10, {})}


@pytest.fixture(scope="module")
def cases():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "CASES", SMALL)
        yield {name: study.Case.of(name) for name in SMALL}


@pytest.fixture(scope="module")
def boxes(cases):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "WIDTHS", np.array([1.0, 0.2, 0.05]))
        trials = range(len(study.PLACES))
        return {
            name: pd.concat([study.boxes_table(name, trial, case) for trial in trials])
            for name, case in cases.items()
        }


def test_bounds_are_found_by_name_and_methods_by_what_they_can_do(cases):
    names = [line.name for line in study.lines(cases["plane"])]
    assert names[: len(BOUND_NAMES)] == list(BOUND_NAMES)
    assert len(set(names)) == len(names)
    able = {name for name in registry.names() if hasattr(registry.load(name), "box_bound")}
    assert {"rpm_htb", "rpm_bp", "hbsp"} <= able
    assert "dcreg" not in able, "its bounds are those of the library"
    assert {"rpm_htb"} == able - set(names), "it has several bounds with names of their own"
    assert set(names) - set(BOUND_NAMES) - able == {"termwise-r1", "termwise-r2", "termwise-r3"}
    in_space = {line.name for line in study.lines(cases["space"])}
    assert set(names) - in_space >= {"termwise-r3", "rpm_bp"}, "written for 2D only"


def test_bounds_of_the_library_and_of_methods_with_several_take_part_in_the_searches(cases):
    termwise = {"termwise-r1", "termwise-r2", "termwise-r3"}
    assert set(study.searched(cases["plane"])) == {*BOUND_NAMES, *study.COMBINED, *termwise}
    assert set(study.searched(cases["space"])) & termwise == termwise - {"termwise-r3"}
    assert study.REFERENCE in BOUND_NAMES


@pytest.mark.parametrize("name", SMALL)
def test_boxes_hold_the_optimum_or_not(name, cases):
    theta = cases[name].theta
    for width in (2.0, 0.05):
        for trial in range(9):
            found = study.placement(name, theta, width, trial)
            assert found or study.PLACES[trial % 3] == "away"
            if found:
                place, box = found
                inside = ((box.lower <= theta) & (theta <= box.upper)).all()
                assert place == study.PLACES[trial % 3]
                assert box.upper - box.lower == pytest.approx(width)
                assert inside == (place != "away")


def test_cases_have_boxes_of_their_own():
    one, other = (study.placement(name, np.zeros(3), 1.0, 1)[1] for name in ("one", "other"))
    assert (one.centre != other.centre).all()


def test_bounds_are_asked_for_their_full_strength(cases, monkeypatch):
    """Without a cutoff to reach, a bound may otherwise stop early."""
    asked = []

    class Recording:
        n_assignments = 1

        def __init__(self, name, space, roots):
            self.roots = roots

        def evaluate(self, boxes, cutoff):
            asked.append((self.roots, cutoff))
            return IntervalBound(cases["plane"].space, self.roots).evaluate(boxes, cutoff)

    monkeypatch.setattr(study, "make_bound", Recording)
    box = Box(cases["plane"].theta - 0.1, cases["plane"].theta + 0.1)
    study.library_bound("tight", cases["plane"], box)
    assert asked == [([box], None)]


@pytest.mark.parametrize("name", SMALL)
def test_every_bound_is_below_the_minimum_objective_found(name, boxes):
    table = boxes[name].dropna(subset="value")
    assert set(BOUND_NAMES) <= set(table["bound"])
    assert (table["value"] <= table["minimum"] + 1e-8).all()
    of_library = table[table["bound"].isin(BOUND_NAMES)]
    assert (of_library["n_assignments"] >= 1).all()


def test_methods_without_a_bound_there_stay_in_the_table(boxes):
    values = boxes["space"].set_index("bound")["value"]
    assert values["hbsp"].isna().all()
    assert "rpm_bp" not in values, "a method of the plane only"


def test_the_reference_loses_once_its_loss_and_first_order_bounds_more_in_small_boxes(boxes):
    losses = study.losses_table(boxes["plane"])
    ratio = losses.set_index(["bound", "place", "width"])["ratio"].sort_index()
    np.testing.assert_allclose(ratio.loc[study.REFERENCE], 1.0)
    for name in ("termwise-r1", "rpm_bp", "hbsp"):
        assert ratio[name, "holding", 0.05] > 2.0


def test_tables_are_stored_with_their_origin(tmp_path, cases, boxes, monkeypatch):
    first = next(iter(boxes))
    monkeypatch.setattr(study, "CASES", [first])
    monkeypatch.setattr(study, "TRIALS", 1)
    monkeypatch.setattr(study.Case, "of", lambda *_: cases[first])
    monkeypatch.setattr(study, "boxes_table", lambda *_: boxes[first])
    monkeypatch.setattr(study, "searches_table", lambda *_: pd.DataFrame({"bound": ["dc"]}))
    study.run(tmp_path, 6.0)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"boxes.csv", "losses.csv", "orders.csv", "searches.csv", "provenance.json"}
    known = json.loads((tmp_path / "provenance.json").read_text())
    assert known["time_s"] == 6.0
    assert known["machine"] == provenance.machine_card()
    assert known["lock_sha256"]


def test_orders_are_the_slopes_of_the_loss():
    widths = np.geomspace(1, 1e-3, 12)
    rows = [
        {"instance": "i", "place": "holding", "bound": name, "width": width, "minimum": 1.0,
         "loss": 5 * width**order}
        for name, order in (("first", 1), ("second", 2)) for width in widths
    ]  # fmt: skip
    rows += [row | {"bound": "exact", "loss": 0.0} for row in rows[:12]]
    orders = study.orders_table(pd.DataFrame(rows)).set_index("bound")["order"]
    assert orders["first"] == pytest.approx(1.0)
    assert orders["second"] == pytest.approx(2.0)
    assert np.isnan(orders["exact"])


def test_work_to_a_gap_is_that_of_the_first_event_there():
    history = pd.DataFrame(
        {"instance": "i", "bound": "b", "n_nodes": [1, 5, 9], "gap": [20.0, 2.0, 0.2]}
    )
    (row,) = page.searches_rows(history, "n_nodes")["rows"]
    assert row == ["b", "5", "5", "9", "9", "–"]


def test_page_is_one_file_for_both_themes(tmp_path, cases, boxes):
    losses = study.losses_table(pd.concat(boxes.values()))
    losses.to_csv(tmp_path / "losses.csv", index=False)
    study.orders_table(losses).to_csv(tmp_path / "orders.csv", index=False)
    searches = [study.searches_table(name, 0, case, 0.1) for name, case in cases.items()]
    pd.concat(searches).to_csv(tmp_path / "searches.csv", index=False)
    text = page.build(tmp_path).read_text(encoding="utf-8")
    assert text.count("<svg") == 4  # two figures on two surfaces
    for line in study.lines(cases["plane"]):
        assert line.name in text
    without_names = text
    for namespace in ("http://www.w3.org", "http://purl.org", "http://creativecommons.org"):
        without_names = without_names.replace(namespace, "")
    assert "http://" not in without_names
    assert {path.name for path in tmp_path.glob("*.pdf")} == {"boxes.pdf", "searches.pdf"}
