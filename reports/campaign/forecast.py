"""Forecast time and disk of runs from the measured ones; times per method, test and level."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from workflows.config import Experiment
from workflows.installed import runs_here
from workflows.stages.plan import PlannedRun

CELL = ["method", "test", "level"]
Pair = tuple[str, str]  # method and test
TIMED = [*CELL, "time_solve_s", "time_overhead_s"]


@dataclass(frozen=True)
class Forecast:
    """Expected time and disk of some runs.

    Attributes
    ----------
    runs : int
    seconds : float
    unseen : int
        Runs that have no measured cell.
    unmeasured : mapping
        The time limits of all runs of methods and tests without any measured run: the expected times of
        these can be far too low.
    megabytes : float or None
        None if no run has been measured.
    """

    runs: int
    seconds: float
    unseen: int
    unmeasured: Mapping[Pair, float] = field(default_factory=dict)
    megabytes: float | None = None

    def __str__(self) -> str:
        disk = "" if self.megabytes is None else f", {self.megabytes:.1f} MB"
        return (
            f"{self.runs} runs, about {self.seconds / 60:.0f} min of run time{disk} "
            f"({self.unseen} runs at levels that were not measured)"
        )


@dataclass(frozen=True)
class Times:
    """Measured seconds of an experiment's runs.

    Attributes
    ----------
    cells : DataFrame
        Number of runs, mean, median and 90th percentile per method, test and level.
    limits : dict of method to seconds
        What a method without any run is expected to take.
    variants : dict of method to list of str
        The methods with the same baseline, itself included.
    bytes_per_run : float or None
        Disk that a run takes, with its share of instances and tables.
    """

    cells: pd.DataFrame
    limits: dict[str, float]
    variants: dict[str, list[str]]
    bytes_per_run: float | None = None

    @classmethod
    def of(
        cls,
        tables: Sequence[pd.DataFrame],
        experiment: Experiment,
        bytes_per_run: float | None = None,
    ) -> Times:
        """Return the times of runs, those of the harness included.

        Of a cell in several tables, the first one counts.
        """
        limits = {each.name: experiment.limits_of(each).time_s for each in experiment.methods}
        variants = {
            each.name: [
                other.name for other in experiment.methods if other.baseline == each.baseline
            ]
            for each in experiment.methods
        }
        known = [_cells(runs) for runs in tables]
        cells = pd.concat(known) if known else _cells(pd.DataFrame(columns=TIMED))
        return cls(cells[~cells.index.duplicated()], limits, variants, bytes_per_run)

    @staticmethod
    def as_limited(runs: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
        """Return runs of the quick part; those at a limit take as long as the limit of the experiment."""
        limits = {each.name: experiment.limits_of(each).time_s for each in experiment.methods}
        limit = runs["method"].map(limits)
        return runs.assign(
            time_solve_s=runs["time_solve_s"].mask(runs["outcome"] == "limited", limit)
        )

    def of_runs(self, runs: Iterable[PlannedRun]) -> Forecast:
        """Return the forecast of planned runs."""
        count, seconds, unseen = 0, 0.0, 0
        measured = {key[:2] for key in self.cells.index}
        unmeasured: dict[Pair, float] = {}
        is_here: dict[str, bool] = {}
        for run in runs:
            count, name = count + 1, run.method.name
            if name not in is_here:
                is_here[name] = runs_here(run.method)
            if not is_here[name]:  # ends at once as unavailable
                continue
            expected, is_seen = self.of_cell(name, run.instance.test, run.instance.level)
            seconds += expected
            unseen += not is_seen
            if (pair := (name, run.instance.test)) not in measured:
                unmeasured[pair] = unmeasured.get(pair, 0.0) + self.limits[name]
        disk = None if self.bytes_per_run is None else count * self.bytes_per_run / 1e6
        return Forecast(count, seconds, unseen, unmeasured, disk)

    @cached_property
    def of_cell(self) -> Callable[[str, str, float], tuple[float, bool]]:
        """The expected seconds of a run by method, test and level, and whether they were measured."""
        return cache(self._of_cell)

    def _of_cell(self, method: str, test: str, level: float) -> tuple[float, bool]:
        """Return the expected seconds of a run, and whether its cell has been measured.

        Between measured levels of a test, times are interpolated linearly; beyond them, they are those of
        the nearest level. In an unseen test, a run takes as long as those of other methods with its
        baseline; without any, the geometric mean of the slowest test of the method, in any experiment,
        and of its limit; otherwise the limit.
        """
        if (method, test, level) in self.cells.index:
            return float(self.cells["mean"].loc[(method, test, level)]), True
        of_method, of_test = (
            self.cells.index.get_level_values(name) for name in ("method", "test")
        )
        for methods in ([method], self.variants[method]):
            same = self.cells["mean"][of_method.isin(methods) & (of_test == test)]
            if len(same):
                means = same.groupby("level").mean()
                return float(np.interp(level, means.index.to_numpy(dtype=float), means)), False
        own = self.cells[of_method == method]
        if len(own):
            slowest = float(own.groupby("test")["mean"].mean().max())
            return float(np.sqrt(slowest * self.limits[method])), False
        return self.limits[method], False


def seconds_of(runs: pd.DataFrame) -> pd.Series:
    """Return the seconds of runs, those of the harness included; NaN if they have none."""
    return runs["time_solve_s"].astype(float) + runs["time_overhead_s"].fillna(0.0).astype(float)


def _cells(runs: pd.DataFrame) -> pd.DataFrame:
    """Return number, mean, median and 90th percentile of the seconds of each cell."""
    grouped = (
        runs.assign(seconds=seconds_of(runs)).dropna(subset="seconds").groupby(CELL)["seconds"]
    )
    return grouped.agg(["size", "mean", "median"]).assign(p90=grouped.quantile(0.9))


def bytes_of(folder: Path) -> int:
    """Return the bytes of the files of a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
