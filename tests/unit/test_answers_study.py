"""The study of answers: what it counts, and that it finds a wrong answer."""

from __future__ import annotations

import dataclasses

import pandas as pd
import pytest

import dcreg
from workflows.disturb import make_instance
from workflows.studies import answers, certifying, inliers
from workflows.studies.proof import Cell, known_axis


def question(shape, name="certify"):
    source = answers.dataset(answers.DATASET)
    raw = make_instance(source, shape, "separate_outliers", 0.3, 0, 12)
    return answers.Question(raw, 2.0, known_axis(raw, 0) if name == "axis" else None)


@pytest.mark.parametrize("name", answers.QUESTIONS)
def test_a_small_problem_is_answered_and_the_planted_pose_agrees(name):
    asked = question("pony" if name == "axis" else "fish", name)
    assert answers.QUESTIONS[name](asked) == (True, False)


@pytest.mark.parametrize(
    ("name", "called", "change"),
    [
        ("certify", "certify", {"lower_bound": 1e3}),
        ("alternatives", "alternatives", {"min_displacement": 0.0, "threshold": 1e3}),
        ("max_inliers", "max_inliers", {"at_most": 3}),
        ("axis", "register", {"lower_bound": 1e3}),
    ],
)
def test_a_false_answer_is_counted(name, called, change, monkeypatch):
    asked = question("pony" if name == "axis" else "fish", name)
    ask = getattr(dcreg, called)
    monkeypatch.setattr(dcreg, called, lambda *a, **k: dataclasses.replace(ask(*a, **k), **change))
    assert answers.QUESTIONS[name](asked)[1]


def test_the_summary_counts_answers():
    rows = pd.DataFrame({
        "question": ["axis", "certify", "axis"], "closed": [True, False, False],
        "wrong": [False, False, True], "time_s": [1.0, 2.0, 3.0],
    })  # fmt: skip
    assert answers.summary(rows).to_dict("records") == [
        {"question": "axis", "problems": 2, "closed": 1, "open": 1, "wrong": 1, "median_s": 2.0},
        {"question": "certify", "problems": 1, "closed": 0, "open": 1, "wrong": 0, "median_s": 2.0},
    ]


def test_certify_is_compared_with_a_solve_of_the_same_problem():
    raw = question("fish").raw
    rows = certifying.compared(raw, 1, 5.0, 0.0)
    assert [row["pose"] for row in rows] == list(certifying.POSES)
    assert [row["verdict"] for row in rows][1:] == ["improvable", "improvable"]
    assert all(row["ratio"] == row["least"] == row["most"] > 0.0 for row in rows)
    table = certifying.summary(pd.DataFrame(rows))
    assert table["problems"].tolist() == [1, 1, 1]
    assert certifying.compared(raw, 1, 5.0, 1e3) == []  # solved too soon


@pytest.mark.parametrize("dim", [2, 3])
def test_an_interval_of_pairs_is_compared_with_the_planted_pose(dim, monkeypatch):
    cell = Cell("embedded", "mixed_outliers", 0.2, 0)
    found = inliers.asked(cell, dim, 0.01, 12, 5.0)
    assert found["closed"]
    assert not found["wrong"]
    assert found["planted"] <= found["at_least"] == found["at_most"] < found["n_possible"]
    ask = dcreg.max_inliers
    monkeypatch.setattr(
        dcreg, "max_inliers", lambda *a, **k: dataclasses.replace(ask(*a, **k), at_most=3)
    )
    assert inliers.asked(cell, dim, 0.01, 12, 5.0)["wrong"]


def test_the_summary_of_intervals_counts_the_closed_ones():
    rows = pd.DataFrame({
        "dim": [2, 2, 3], "ratio": 0.1, "at_least": [9, 8, 7], "at_most": [9, 12, 8],
        "closed": [True, False, False], "wrong": False, "time_s": 1.0, "cpu_s": 1.0,
    })  # fmt: skip
    table = inliers.summary(rows)
    assert table["closed"].tolist() == [1, 0]
    assert table["median_width"].tolist() == [2.0, 1.0]
