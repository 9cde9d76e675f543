"""The thinned clouds of an archive, from which a report draws the view of each run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from reports.tables import Tables
from workflows.stages.clouds import CLOUDS, thinned

MOST_POINTS = 100  # of a cloud


def write(tables: Sequence[Tables], out: Path, room: int) -> dict[str, dict[str, int]]:
    """Write the clouds of experiments to ``experiments/NAME`` in `out`, at most `room` bytes.

    Of an experiment whose clouds are too large, only those of the first instances are written.

    Returns
    -------
    dict of str to dict
        By experiment: ``stored`` instances ``of`` those that have clouds. Experiments without clouds are
        missing.
    """
    counts = {}
    for each in tables:
        path = each.directory / CLOUDS
        if not path.is_file():
            continue
        place = out / "experiments" / each.experiment / CLOUDS
        found = _thinned(pd.read_parquet(path))
        stored = _fit(found, place, room)
        room -= place.stat().st_size if stored else 0
        counts[each.experiment] = {"stored": stored, "of": len(found)}
    return counts


def sentences(facts: Mapping[str, Any]) -> Iterator[str]:
    """Yield a sentence per experiment whose clouds are not, or not all, in the archive."""
    for name, one in facts["experiments"].items():
        known = one.get("clouds")
        if known is None:
            yield f"Clouds of experiment {name} are only in its overlays."
        elif known["stored"] < known["of"]:
            yield (
                f"The archive has the clouds of {known['stored']} of {known['of']} instances of {name}, "
                "the first ones of its plan."
            )


def _thinned(table: pd.DataFrame) -> pd.DataFrame:
    columns = [table[name] for name in ("instance_id", "dim", "source", "target", "pairs")]
    return pd.DataFrame([_row(*values) for values in zip(*columns, strict=True)])


def _row(
    instance: str, dim: int, source: np.ndarray, target: np.ndarray, pairs: np.ndarray
) -> dict[str, Any]:
    source, target, pairs = thinned(
        source.reshape(-1, dim), target.reshape(-1, dim), pairs.reshape(-1, 2), MOST_POINTS
    )
    return {
        "instance_id": instance,
        "dim": dim,
        "source": source.ravel(),
        "target": target.ravel(),
        "pairs": pairs.ravel().astype(np.int32),
    }


def _fit(table: pd.DataFrame, path: Path, room: int) -> int:
    """Write as many of the first rows as fit into `room` bytes, by halves; return their number."""
    count = len(table)
    while count:
        table.iloc[:count].to_parquet(path, index=False, compression="zstd", compression_level=19)
        if path.stat().st_size <= room:
            return count
        count //= 2
    path.unlink(missing_ok=True)
    return 0
