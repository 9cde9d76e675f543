"""Details of each run: pose, bounds and history, and the clouds of its instance, in few files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from dcreg.names import POSE_SCOPES
from reports.runs import clouds
from reports.tables import Tables, reason, thin_trace
from workflows.attribution import VERDICTS

MAX_FILES = 40
FILE_WEIGHT = 20_000  # numbers in a file
MAX_EVENTS = 120  # of a stage of a run
_OF_RUN = 60  # numbers of a run without a history, about
# Numbers of a run that the list of runs does not have.
FACTS = (
    "rmse_excess", "rmse_floor", "translation_error", "scale_error", "objective", "objective_true",
    "objective_best", "lower_bound", "upper_bound", "gap", "gap_tol", "n_inliers", "n_inliers_true",
    "n_source", "n_target", "noise_bound", "n_assignments",
)  # fmt: skip
HISTORY = {
    "time": "time_s",
    "nodes": "n_nodes",
    "assignments": "n_assignments",
    "lower": "lower_bound",
    "upper": "upper_bound",
}


class Details:
    """The details of some runs, in files that the page loads on demand.

    Attributes
    ----------
    chunk_of : Series
        The number of its file, by instance.
    """

    def __init__(self, tables: Tables, runs: pd.DataFrame) -> None:
        self.tables, self.runs = tables, runs
        self.clouds = clouds.of_instances(tables)
        self.histories = histories(tables, runs)
        self.chunk_of = self._divide()

    def _divide(self) -> pd.Series:
        """Divide the instances, in the order of the runs, into files of similar size."""
        weight = self.runs["run_id"].map(
            lambda run: (
                _OF_RUN + sum(5 * len(s["time"]) for s in self.histories.get(run, {}).values())
            )
        )
        weights = weight.groupby(self.runs["instance_id"], sort=False).sum()
        for name in weights.index.intersection(list(self.clouds)):
            known = self.clouds[name]
            weights[name] += 3 * (len(known["source"]) + len(known["target"])) + len(known["pairs"])
        total = int(weights.sum())
        each = max(FILE_WEIGHT, -(-total // (MAX_FILES - 1)))
        return (weights.cumsum() - weights) // each

    def chunks(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield the number and the content of each file."""
        for number, part in self.runs.groupby(self.runs["instance_id"].map(self.chunk_of)):
            names = part["instance_id"].unique()
            yield (
                int(number),
                {
                    "clouds": {name: self.clouds[name] for name in names if name in self.clouds},
                    "runs": {str(run["run_id"]): self._of_run(run) for _, run in part.iterrows()},
                },
            )

    def _of_run(self, run: pd.Series) -> dict[str, Any]:
        card = self.tables.cards.get(run["method"], {})
        return {
            **{name: run[name] for name in FACTS if run[name] == run[name]},
            "instance": run["instance_id"],
            "pose": _pose(run["T_target_source"]),
            "reference": _pose(run["T_reference"]),
            "reason": reason(run["status"], run["message"], card),
            "scope": run["certificate_scope"],
            "is_of_pose": run["certificate_scope"] in POSE_SCOPES,
            "cause": VERDICTS.get(run["verdict"], ("",))[0],
            "stages": self.histories.get(run["run_id"], {}),
        }


def histories(tables: Tables, runs: pd.DataFrame) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return the thinned bound history of each stage of each run."""
    import polars as pl

    wanted = pl.from_pandas(runs[["run_id"]]).lazy()
    events = tables.scan_traces().join(wanted, on="run_id", how="semi", maintain_order="left")
    table = events.collect(engine="streaming").to_pandas()
    found: dict[str, dict[str, dict[str, list[float]]]] = {}
    for (run, stage), part in table.groupby(["run_id", "stage"], sort=False):
        kept = thin_trace(part, MAX_EVENTS)
        found.setdefault(str(run), {})[str(stage)] = {
            name: np.asarray(kept[column], float).tolist() for name, column in HISTORY.items()
        }
    return found


def _pose(text: str) -> list[list[float]] | None:
    return json.loads(text) if text else None
