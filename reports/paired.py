"""Two methods on the instances that both attempted: who wins, and whether that may be due to chance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from reports.tables import Tables, is_right
from workflows.judges import SAME
from workflows.outcomes import attempted, comparable_times
from workflows.significance import exact_p

PLACE = ["test", "shape", "level", "trial"]
COMPARED = ["model", "instance_id", "method", "run_id", "outcome", "success", "rmse", *PLACE]


def comparisons(tables: Tables) -> list[dict[str, Any]]:
    """Return for each model the runs by method and instance, and the counts and tests of all pairs.

    Models in which fewer than two methods were attempted are left out.
    """
    runs = attempted(tables.runs[COMPARED].assign(time=comparable_times(tables.runs)))
    runs = runs.assign(right=is_right(runs))
    models = [
        _comparison(str(model), part, tables.methods)
        for model, part in runs.groupby("model", sort=False)
    ]
    if tables.is_of_blocks:  # no test for a fixed number of runs is valid
        for cell in (
            c for each in models for t in each["counts"].values() for row in t for c in row
        ):
            cell[-1] = np.nan
    return [each for each in models if len(each["methods"]) > 1]


def _comparison(model: str, runs: pd.DataFrame, order: list[str]) -> dict[str, Any]:
    first = runs.drop_duplicates("instance_id")
    index = pd.Index(first["instance_id"])
    methods = [name for name in order if (runs["method"] == name).any()]

    def grid(column: str) -> pd.DataFrame:
        table = runs.pivot_table(
            index="instance_id", columns="method", values=column, aggfunc="first"
        )
        return table.reindex(index=index, columns=methods)

    ids, right = grid("run_id"), grid("right")
    rmse, time = grid("rmse"), grid("time")
    tried = ids.notna().to_numpy()
    is_good = right.fillna(False).astype(bool).to_numpy()
    error = np.where(tried, rmse.fillna(np.inf), np.nan)
    seconds = np.where(is_good, time, np.nan)
    return {
        "model": model,
        "methods": methods,
        "instances": {column: list(first[column]) for column in PLACE},
        "runs": [
            {
                "run": list(ids[name].where(ids[name].notna(), None)),
                "right": [bool(good) for good in is_good[:, column]],
                "rmse": list(rmse[name].astype(float)),
                "time": list(time[name].astype(float)),
            }
            for column, name in enumerate(methods)
        ],
        "counts": {
            "right": _counts(np.where(tried, is_good, np.nan), lambda one, other: one > other),
            "rmse": _counts(error, _is_less),
            "time": _counts(seconds, _is_less),
        },
    }


def _is_less(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return where `one` is less than `other` by more than rounding."""
    return one < other * (1.0 - SAME)


def _counts(
    values: np.ndarray, is_better: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> list[list[list[float]]]:
    """Return wins, ties, losses and p-value of each row's method against each column's.

    `values` has a column per method; a pair of methods is compared where neither is NaN.
    """
    known = ~np.isnan(values)
    shared = known.T.astype(int) @ known.astype(int)
    wins = np.array([is_better(values[:, [i]], values).sum(axis=0) for i in range(values.shape[1])])
    ties = shared - wins - wins.T
    cells = np.stack([wins, ties, wins.T, exact_p(wins, wins.T)], axis=-1)
    return cells.tolist()
