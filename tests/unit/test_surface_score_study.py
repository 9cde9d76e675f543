"""The study of both scores of `register_matches`: its paired statistics, and a run that continues."""

import pandas as pd
import pytest

from data.registry import dataset
from workflows.studies import surface_score as study


def test_the_difference_has_the_exact_interval_of_discordant_pairs():
    found = study.difference(8, 2, 50)
    assert found.difference == pytest.approx(12.0)
    # Clopper and Pearson's interval of 8 in 10, and McNemar's exact p-value
    assert found.low == pytest.approx(100 * (2 * 0.4439 - 1) * 10 / 50, abs=0.02)
    assert found.high == pytest.approx(100 * (2 * 0.9748 - 1) * 10 / 50, abs=0.02)
    assert found.p_value == pytest.approx(112 / 1024, abs=1e-4)
    mirrored = study.difference(2, 8, 50)
    assert (mirrored.low, mirrored.high) == (-found.high, -found.low)
    assert study.difference(0, 0, 50) == (0.0, 0.0, 0.0, 1.0)


def test_a_list_counts_pairs_that_one_score_registers_alone():
    pairs = pd.DataFrame(
        {
            "list": ["a"] * 4 + ["b"],
            "correspondences_right": [True, True, False, False, True],
            "surfaces_right": [True, False, True, False, True],
            "correspondences_time_s": 1.0,
            "surfaces_time_s": 2.0,
        }
    )
    first, second = study.paired(pairs).to_dict("records")
    assert (first["pairs"], first["gained"], first["lost"], first["difference"]) == (4, 1, 1, 0.0)
    assert (second["correspondences_right"], second["surfaces_right"], second["p_value"]) == (
        1,
        1,
        1,
    )


def test_a_run_continues_with_the_missing_pairs(tmp_path, monkeypatch):
    loaded = []

    def load(self, shape, test, level, trial, n_points):
        loaded.append(test)
        return None

    row = {
        f"{score}_{key}": 1
        for score in ("correspondences", "surfaces")
        for key in ("right", "time_s")
    }
    monkeypatch.setattr(type(dataset("threedmatch")), "load", load)
    monkeypatch.setattr(study, "compared", lambda raw: row)
    study.main(tmp_path, every=800, first=0)
    assert loaded == ["3DMatch"] * 3 + ["3DLoMatch"] * 3
    study.main(tmp_path, every=800, first=400)
    assert len(loaded) == 6 + 2 + 2
    study.main(tmp_path, every=400, first=0)
    assert len(loaded) == 10
    assert len(pd.read_csv(tmp_path / "pairs.csv")) == 10
