"""Lines over all recorded versions, and the steps in them.

A step is a verdict of `workflows.compare` on two consecutive records of an experiment: counters exactly,
quality by a sign test on the same instances, times by the interval of their ratio and only between
records with one machine card.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd

from workflows import recording
from workflows.compare import Verdict, corrected, judge_records
from workflows.recording import Record

Value = Callable[[pd.DataFrame], float]
STEPS = ("worse", "better", "changed", "slower", "faster")


@dataclass(frozen=True)
class Metric:
    """A metric as in the verdicts of `workflows.compare`, and its value for the runs of a method."""

    title: str
    unit: str
    better: str
    value: Value
    is_time: bool = False


@dataclass(frozen=True)
class Point:
    """The value of one version; `step` is the verdict against the version before, if it is a step.

    `before` is the value of that version.
    """

    version: str
    value: float
    machine: str
    before: float
    step: Verdict | None = None


@dataclass(frozen=True)
class Line:
    """One metric of one method over all versions that have it."""

    metric: Metric
    points: list[Point]

    @property
    def steps(self) -> list[Point]:
        return [point for point in self.points if point.step is not None]


@dataclass(frozen=True)
class History:
    """All records of one experiment, the earliest first."""

    experiment: str
    records: dict[str, Record]  # by version
    lines: dict[str, list[Line]]  # by method


def _share(column: str, value: str | bool) -> Value:
    return lambda runs: 100 * float(runs[column].eq(value).mean())


def _median(column: str) -> Value:
    return lambda runs: float(runs[column].median())


def _sum(column: str) -> Value:
    return lambda runs: float(runs[column].sum(min_count=1))


def _count(tell: Callable[[pd.DataFrame], pd.Series]) -> Value:
    return lambda runs: float(tell(runs).sum())


def _mean_log(column: str) -> Value:
    def value(runs: pd.DataFrame) -> float:
        known = runs.loc[runs[column] > 0, column]
        return float(np.exp(np.log(known).mean())) if len(known) else np.nan

    return value


def _certified(runs: pd.DataFrame) -> float:
    bounded = runs["gap"].notna().any()
    return _share("status", "optimal")(runs) if bounded else np.nan


METRICS = {
    "success": Metric("success", "% of runs", "higher", _share("success", True)),
    "certified": Metric("certified", "% of runs", "higher", _certified),
    "without pose": Metric(
        "without pose", "runs", "lower", _count(lambda runs: runs["rmse"].isna())
    ),
    "wrong bounds": Metric(
        "wrong bounds", "runs", "lower", _count(lambda runs: runs["bound_violation"] > 0)
    ),
    "n_nodes": Metric("boxes", "sum", "lower", _sum("n_nodes")),
    "n_assignments": Metric("assignments", "sum", "lower", _sum("n_assignments")),
    "median rmse": Metric("RMSE", "median, target units", "lower", _median("rmse")),
    "median objective": Metric(
        "objective", "median, squared target units", "lower", _median("objective")
    ),
    "median primal integral": Metric(
        "primal integral", "median, boxes", "lower", _median("primal_integral_boxes")
    ),
    "median dual integral": Metric(
        "dual integral", "median, boxes", "lower", _median("dual_integral_boxes")
    ),
    "median gap integral": Metric(
        "gap integral", "median, boxes", "lower", _median("gap_integral_boxes")
    ),
    "time_solve_s": Metric(
        "time", "s, geometric mean", "lower", _mean_log("time_solve_s"), is_time=True
    ),
}


def load(history: Path = recording.HISTORY) -> list[History]:
    """Return the history of every recorded experiment.

    Raises
    ------
    RecordError, SchemaError
    """
    by_experiment: dict[str, dict[str, Record]] = {}
    for version in recording.versions(history):
        for name, record in recording.read(version, history).items():
            by_experiment.setdefault(name, {})[version] = record
    return [
        History(name, records, dict(_lines(records))) for name, records in by_experiment.items()
    ]


def _lines(records: dict[str, Record]) -> Iterator[tuple[str, list[Line]]]:
    versions = list(records)
    verdicts = {
        (new, found.method, found.metric): found
        for old, new in pairwise(versions)
        for found in corrected([*judge_records("", records[old], records[new])])
        if found.verdict in STEPS
    }
    for method in dict.fromkeys(name for each in records.values() for name in each.runs["method"]):
        lines = []
        for key, metric in METRICS.items():
            points: list[Point] = []
            for version, runs in _runs_of(records, method):
                if np.isfinite(value := metric.value(runs)):
                    before = points[-1].value if points else np.nan
                    step = verdicts.get((version, method, key))
                    points.append(Point(version, value, _machine(runs), before, step))
            if points:
                lines.append(Line(metric, points))
        yield method, lines


def _runs_of(records: dict[str, Record], method: str) -> Iterator[tuple[str, pd.DataFrame]]:
    for version, record in records.items():
        runs = record.runs[record.runs["method"] == method]
        if len(runs):
            yield version, runs


def _machine(runs: pd.DataFrame) -> str:
    return ", ".join(sorted(set(runs["machine_id"]) - {""}))
