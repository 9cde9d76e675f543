"""The study of refuted matches: its problems, and the summary of its answers."""

import numpy as np
import pandas as pd
import pytest

from dcreg.problem import apply_pose
from workflows.studies import questions
from workflows.studies import refute as study


@pytest.fixture
def random_keypoints(monkeypatch):
    def keypoints(scene, number):
        rng = np.random.default_rng([len(scene), number])
        size = (study.N_POINTS, 3)
        return study.Keypoints(rng.uniform(0.0, 2.5, size), rng.standard_normal(size))

    monkeypatch.setattr(study, "keypoints", keypoints)
    monkeypatch.setattr(study, "N_POINTS", 50)


def test_planted_questions_are_met_and_none_is_refuted(random_keypoints):
    answers = [study.answer("planted", number, 5, 10.0) for number in range(10)]
    assert {answer["status"] for answer in answers} == {"met"}
    question = study.planted(0, 5)
    assert question.is_met_by(question.T_known)
    assert not question.is_met_by(np.eye(4))


def test_different_clouds_are_refuted(random_keypoints):
    answer = study.answer("different", 0, 5, 10.0)
    assert answer["status"] == "refuted"
    assert answer["rms_proven"] >= study.MAX_RMS


def test_the_summary_counts_answers_by_kind():
    kinds = ["different"] * 4 + ["planted"] * 2
    status = ["refuted", "refuted", "refused", "converged", "met", "refuted"]
    answers = pd.DataFrame({"kind": kinds, "status": status, "cpu_s": [0.5, 2.0, 0.0, 9, 0.1, 1]})
    answers["is_false"] = [False] * 5 + [True]
    different, planted = study.summary(answers).to_dict("records")
    assert (different["questions"], different["refuted 1 s"], different["refuted 10 s"]) == (
        4,
        2,
        3,
    )
    assert (different["met"], different["open"], different["false"]) == (0, 1, 0)
    assert (planted["questions"], planted["met"], planted["false"]) == (2, 1, 1)


def test_every_question_is_answered_about_one_pair(rng):
    points, T = rng.random((14, 3)), np.eye(4)
    T[:3] = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0]]
    pair = (points, apply_pose(T, points))
    answered = dict(questions.answers(questions.Asked(pair, T, np.arange(1.0, 15.0), 10.0)))
    assert answered["how many pairs are within 0.1 m?"].startswith("exactly 14 pairs")
    assert answered["how many pairs does the library choose?"].startswith("14 (")
    assert answered["is the official pose optimal?"].startswith("`optimal`")
    assert answered["do *k* pairs fit with an RMS residual of 0.01 m?"].startswith("yes")
    assert answered["which scale is best (`similarity3d`)?"].startswith("1.000")
    assert answered["does `verify` accept the certificate?"].startswith("`proven`")
    table = questions.written(answered, answered, 14)
    assert table.count("\n") == len(answered) + 2 == 16
