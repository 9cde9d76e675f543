"""The clouds of all instances, rounded and thinned, so that a report can draw every run."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

from workflows.instances import Problem, Truth, read_problems, read_truths
from workflows.stages.plan import Plan

CLOUDS = "clouds.parquet"
# Most points of a cloud and of all clouds together; if there are few instances, each keeps more points.
MOST_POINTS, FEWEST_POINTS, POINTS = 400, 60, 800_000
MOST_INSTANCES = 10_000
DIGITS = 4  # of coordinates, relative to the extent of the cloud


def clouds(plan: Plan, folder: Path) -> pd.DataFrame:
    """Return a row per instance: its clouds, flattened, and its true pairs as row numbers.

    At most `MOST_INSTANCES`, the first ones of the plan.
    """
    count = min(MOST_INSTANCES, sum(len(chunk.instances) for chunk in plan.chunks))
    most = max(FEWEST_POINTS, min(MOST_POINTS, POINTS // max(1, 2 * count)))
    rows: list[dict[str, object]] = []
    for chunk in plan.chunks:
        if len(rows) >= count:
            break
        path = folder / "truth" / f"{chunk.name}.npz"
        truths = read_truths(path) if path.is_file() else {}
        for problem in read_problems(folder / "instances" / f"{chunk.name}.npz"):
            rows.append(_row(problem, truths.get(problem.instance_id), most))
    names = ["instance_id", "dim", "source", "target", "pairs"]
    return pd.DataFrame(rows[:count], columns=names)


def _row(problem: Problem, truth: Truth | None, most: int) -> dict[str, object]:
    pairs = np.empty((0, 2), int) if truth is None else np.asarray(truth.pairs, int)
    source, target, pairs = thinned(problem.source, problem.target, pairs, most)
    return {
        "instance_id": problem.instance_id,
        "dim": problem.source.shape[1],
        "source": rounded(source).ravel(),
        "target": rounded(target).ravel(),
        "pairs": pairs.ravel().astype(np.int32),
    }


def thinned(
    source: np.ndarray, target: np.ndarray, pairs: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return at most `most` points of each cloud, and the pairs among them as row numbers.

    Both points of a pair are kept or dropped; the share of kept pairs equals that of kept points.
    """
    share = min(1.0, most / max(len(source), len(target)))
    pairs = _spread(pairs, math.ceil(share * len(pairs)))
    kept = [_rows(len(cloud), pairs[:, side], most) for side, cloud in enumerate((source, target))]
    places = [np.searchsorted(rows, pairs[:, side]) for side, rows in enumerate(kept)]
    return source[kept[0]], target[kept[1]], np.stack(places, axis=1)


def _rows(count: int, paired: np.ndarray, most: int) -> np.ndarray:
    """Return the rows of paired points and, up to `most`, others."""
    paired = np.unique(paired)
    others = np.setdiff1d(np.arange(count), paired)
    return np.sort(np.concatenate([paired, _spread(others, most - len(paired))]))


def _spread(values: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` evenly spaced rows."""
    if len(values) <= most:
        return values
    return values[np.linspace(0, len(values) - 1, max(0, most)).round().astype(int)]


def rounded(points: np.ndarray) -> np.ndarray:
    """Round coordinates to `DIGITS` digits of the extent of the points."""
    extent = float(np.ptp(points, axis=0).max(initial=0.0)) if len(points) else 0.0
    return points.round(max(0, DIGITS - math.floor(math.log10(extent)))) if extent > 0.0 else points
