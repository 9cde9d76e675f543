"""The ablation of bounds: boxes, orders of convergence, figures and page."""

import numpy as np
import pandas as pd
import pytest

from dcreg.bounds import BOUNDS
from dcreg.search import Limits
from reports import ablation as page
from workflows import ablation


@pytest.fixture(scope="module")
def instance():
    return ablation.Instance.of("complete", "fish", "noise", 0.03, 12)


@pytest.fixture(scope="module")
def optimum(instance):
    return ablation.search("tight", instance, 1e-3 * instance.gap_tol, Limits())


def test_boxes_hold_the_optimum_or_not(optimum):
    for width in (2.0, 0.01):
        places = ablation.placements(optimum.theta, width, np.random.default_rng(0))
        for name, boxes in places.items():
            assert boxes or name == "away"
            for box in boxes:
                inside = ((box.lower <= optimum.theta) & (optimum.theta <= box.upper)).all()
                assert (box.upper - box.lower) == pytest.approx(width)
                assert inside == (name != "away" or (inside and width > 1))


@pytest.mark.parametrize("name", BOUNDS)
def test_every_bound_is_below_the_least_objective_met(name, instance, optimum):
    rng = np.random.default_rng(1)
    for boxes in ablation.placements(optimum.theta, 0.3, rng).values():
        for box in boxes:
            value, spent, _ = ablation.bound_value(name, instance, box)
            assert value <= ablation.least_found(instance, box, rng) + 1e-9
            assert spent >= 1


def test_orders_are_the_slopes_of_the_loss():
    widths = np.geomspace(1, 1e-3, 12)
    rows = [
        {"instance": "i", "place": "holding", "draw": 0, "bound": name, "width": width,
         "value": 1.0 - 5 * width**order, "least": 1.0}
        for name, order in (("first", 1), ("second", 2)) for width in widths
    ]  # fmt: skip
    rows += [row | {"bound": "exact", "value": 1.0} for row in rows[:12]]
    orders = ablation.orders_table(pd.DataFrame(rows)).set_index("bound")["order"]
    assert orders["first"] == pytest.approx(1.0)
    assert orders["second"] == pytest.approx(2.0)
    assert np.isnan(orders["exact"])


def test_work_to_a_gap_is_that_of_the_first_event_there():
    history = pd.DataFrame(
        {"instance": "i", "bound": "b", "n_nodes": [1, 5, 9], "gap": [20.0, 2.0, 0.2]}
    )
    (row,) = page.searches_rows(history, "n_nodes")["rows"]
    assert row == ["b", "5", "5", "9", "9", "–"]


def test_page_is_one_file_for_both_themes(tmp_path, instance, optimum):
    table = ablation.bounds_table(instance, optimum.theta)
    table.to_csv(tmp_path / "bounds.csv", index=False)
    ablation.orders_table(table).to_csv(tmp_path / "orders.csv", index=False)
    ablation.searches_table(instance, 0.2).to_csv(tmp_path / "searches.csv", index=False)
    built = page.build(tmp_path)
    text = built.read_text(encoding="utf-8")
    assert text.count("<svg") == 4  # two figures on two surfaces
    for name in BOUNDS:
        assert name in text
    assert "http://" not in text.replace("http://www.w3.org", "").replace(
        "http://purl.org", ""
    ).replace("http://creativecommons.org", "")
    assert {path.name for path in tmp_path.glob("*.pdf")} == {"bounds.pdf", "searches.pdf"}
    again = page.build(tmp_path).read_text(encoding="utf-8")
    assert again == text, "the same tables give the same page"
