"""The study of isolated poses: what it counts, and that it finds a false bound."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest

import dcreg
from data.registry import dataset
from workflows.disturb import make_instance
from workflows.studies import isolation as study


@pytest.mark.parametrize("level", [0.0, 0.02])
def test_the_bound_of_a_small_problem_is_reached(level):
    raw = make_instance(dataset("embedded"), "fish", "noise", level, 0, 20)
    found = study.bounded(raw, 10.0, 0.15, 0.01)
    assert (found["right"], found["reached"], found["false"]) == (True, True, False)
    assert found["ratio"] > study.RATIO
    assert found["rms_proven"] > 0.01


def test_a_bound_above_the_objective_of_the_true_pose_is_false(monkeypatch):
    raw = make_instance(dataset("embedded"), "fish", "noise", 0.02, 0, 20)
    best = dcreg.alternatives(
        raw.source, raw.target, n_inliers=20, model="similarity2d", isolated=0.15, time_limit=10
    )
    far = best.result.T_target_source + np.array([[0, 0, 0.2], [0, 0, 0], [0, 0, 0]])
    result = dataclasses.replace(best.result, T_certified=far)
    false = dataclasses.replace(best, result=result, lower_bound=1.0)
    monkeypatch.setattr(dcreg, "alternatives", lambda *_, **__: false)
    assert study.bounded(raw, 10.0, 0.15, 0.01)["false"]


def test_the_summary_counts_bounds_of_right_answers():
    rows = pd.DataFrame({
        "dim": [2, 2, 3], "level": [0.0, 0.0, 0.01], "right": [True, False, True],
        "reached": [True, True, False], "false": [False, False, True], "ratio": [np.inf, 2.0, 1.2],
        "rms_proven": [0.1, 0.2, 0.3], "cpu_s": [1.0, 9.0, 3.0],
    })  # fmt: skip
    flat, solid = study.summary(rows).to_dict("records")
    assert (flat["problems"], flat["right"], flat["reached"], flat["false"]) == (2, 1, 1, 0)
    assert (solid["problems"], solid["right"], solid["reached"], solid["false"]) == (1, 1, 0, 1)
    assert flat["max_cpu_s"] == 1.0
