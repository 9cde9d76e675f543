"""One pair of a batch: the search and the row of its result."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

import dcreg
from dcreg.cli.numbers import parse_count_or_auto
from dcreg.cli.options import CloudFiles, Goal, Poses, Search, flag, with_options
from dcreg.names import MAX_RMS_SLACK, MODEL_DIM

# The text of each column of a table of results.
Row = dict[str, str]
# The options of the arguments of the library, for messages.
_OPTIONS = {
    each.name.removesuffix("_path"): flag(each.name)
    for group in (Goal, Search, Poses)
    for each in fields(group)
}
_NUMBERS = ("n_inliers", "objective", "rmse_matched", "lower_bound", "upper_bound")


@dataclass(frozen=True)
class Task:
    """A pair to solve.

    Attributes
    ----------
    place : int
        Row of the pair in its table.
    source, target : str
        Files of points.
    n_inliers : str
        As on the command line.
    max_rms : float, optional
    search : Search
    poses : Poses
    drop_invalid : bool
    """

    place: int
    source: str
    target: str
    n_inliers: str
    max_rms: float | None
    search: Search
    poses: Poses
    drop_invalid: bool


def columns(model: str) -> list[str]:
    """Return the columns of a table of results."""
    size = range(MODEL_DIM[model] + 1)
    return [
        *("source", "target", "source_id", "target_id", "status"),
        *_NUMBERS,
        "certificate_scope",
        *(f"T{i}{j}" for i in size for j in size),
        *("dropped_source", "dropped_target", "time_s", "warning", "error", "covariance", "inputs"),
    ]


def solve(task: Task) -> Row:
    """Return the status, pose and bounds of a pair, or the error that prevented them."""
    began = time.perf_counter()
    try:
        row = _solved(task)
    except dcreg.InputError as error:
        row = failed(with_options(str(error), _OPTIONS | task.poses.names))
    except Exception as error:
        row = failed(f"{type(error).__name__}: {error}")
    return {**row, "time_s": f"{time.perf_counter() - began:.3f}"}


def failed(message: str) -> Row:
    """Return the row of a pair without a result."""
    return {"status": dcreg.Status.FAILED.value, "error": " ".join(message.split())}


def is_matched(row: Row, max_rms: float | None) -> bool:
    """Tell whether a row has a pose whose RMS residual is at most `max_rms`, if that is given."""
    if row["status"] == dcreg.Status.FAILED.value:
        return False
    if max_rms is None or row["status"] == dcreg.Status.OPTIMAL.value:
        return True
    return float(row["rmse_matched"]) <= max_rms * (1.0 + MAX_RMS_SLACK)


def answer_of(row: Row, max_rms: float | None) -> str:
    """Return the status of a row, or ``open`` if its search ended without an answer to `max_rms`."""
    is_open = row["status"] == dcreg.Status.CONVERGED.value and not is_matched(row, max_rms)
    return "open" if is_open else row["status"]


def _solved(task: Task) -> Row:
    clouds = CloudFiles(task.source, task.target, drop_invalid=task.drop_invalid)
    points = clouds.read(task.search.model)
    keywords, options = task.search.settings(clouds)
    keywords |= {"n_inliers": parse_count_or_auto(task.n_inliers), "max_rms": task.max_rms}
    keywords["pose_range"], options["init"] = task.poses.settings()
    result = dcreg.register(*points, **keywords, options=dcreg.SolveOptions(**options))
    return {
        "status": result.status.value,
        **{name: _text(getattr(result, name)) for name in _NUMBERS},
        "certificate_scope": result.certificate_scope,
        **{f"T{i}{j}": _text(x) for (i, j), x in np.ndenumerate(result.T_target_source)},
        **{name: str(n) for name, n in clouds.n_dropped.items()},
        "warning": " | ".join(result.warnings),
        "covariance": _covariance_text(result.covariance),
    }


def _text(value: Any) -> str:
    """Return a number as the shortest text that gives it back."""
    return str(value) if isinstance(value, int | np.integer) else repr(float(value))


def _covariance_text(covariance: np.ndarray | None) -> str:
    """Return the upper triangle, row by row."""
    if covariance is None:
        return ""
    return " ".join(map(_text, covariance[np.triu_indices(len(covariance))]))


def edge_of(row: Row) -> dcreg.PoseEdge | None:
    """Return the pose of a row as an edge of a pose graph; None if the pair failed."""
    if row["status"] == dcreg.Status.FAILED.value:
        return None
    pose = [float(text) for name, text in row.items() if name[0] == "T"]
    size = round(len(pose) ** 0.5)
    covariance, values = None, row["covariance"].split()
    if values:
        length = {3: 4, 4: 6}[size]
        covariance = np.zeros((length, length))
        covariance[np.triu_indices(length)] = [float(value) for value in values]
        covariance += np.triu(covariance, 1).T
    ends = int(row["source_id"]), int(row["target_id"])
    return dcreg.PoseEdge(*ends, np.reshape(pose, (size, size)), covariance)
