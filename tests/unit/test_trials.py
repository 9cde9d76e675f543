"""Verdicts count the instances of a trial as independent, although its levels share a pose.

Their intervals are over instances, whose values also differ by level. Here the standard errors are
compared with those of the means of trials.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from workflows import archives
from workflows.archives import RUNS
from workflows.outcomes import ENDED

EXPERIMENTS = "paper2d-40", "paper3d-40"
FEWEST = 8  # trials; the error from fewer is itself too uncertain


def ratios(runs: pd.DataFrame, quantity: str) -> np.ndarray:
    """Return the standard error from trials over that from instances, by method and test."""
    found = []
    for _, part in runs.dropna(subset=quantity).groupby(["experiment", "method", "test"]):
        values = part[quantity].astype(float)
        sums = (values - values.mean()).groupby([part["shape"], part["trial"]]).sum()
        n, spread = len(sums), values.std()
        if n >= FEWEST and spread > 0:
            by_trial = np.sqrt((sums**2).sum() * n / (n - 1)) / len(values)
            found.append(by_trial / (spread / np.sqrt(len(values))))
    return np.array(found)


def test_errors_from_trials_are_usually_smaller_than_from_instances():
    folder = archives.folders()[-1]
    runs = pd.read_parquet(folder / RUNS)
    runs = runs[runs["outcome"].isin(ENDED) & runs["experiment"].isin(EXPERIMENTS)]
    for quantity in ("success", "rmse"):
        found = ratios(runs, quantity)
        assert len(found) >= 8
        assert np.median(found) < 1.0
        assert found.max() < 1.5
