"""The clouds of instances, and pairs of points, for display."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from data.sampling import mutual_nearest
from dcreg.problem import apply_pose
from reports.tables import Tables
from workflows.stages.clouds import CLOUDS, rounded

# How the pairs are known, by the table that they come from.
TRUE, NEAREST = "true", "nearest"


def of_instances(tables: Tables) -> dict[str, dict[str, Any]]:
    """Return ``source``, ``target``, ``pairs`` and their kind by instance.

    They are those of the table of clouds. Other instances have the clouds of the overlays; their pairs
    are mutual nearest neighbours at the reference pose, closer than the noise bound.
    """
    path = tables.directory / CLOUDS
    stored = dict(_stored(pd.read_parquet(path))) if path.is_file() else {}
    return stored | dict(_overlaid(tables, set(stored)))


def _stored(table: pd.DataFrame) -> Iterator[tuple[str, dict[str, Any]]]:
    columns = (table[name] for name in ("instance_id", "dim", "source", "target", "pairs"))
    for name, dim, source, target, pairs in zip(*columns, strict=True):
        yield (
            name,
            {
                "source": source.reshape(-1, dim).tolist(),
                "target": target.reshape(-1, dim).tolist(),
                "pairs": pairs.reshape(-1, 2).tolist(),
                "kind": TRUE,
            },
        )


def _overlaid(tables: Tables, stored: set[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the clouds of the other instances."""
    facts = ["instance_id", "T_reference", "noise_bound"]
    runs = tables.runs.set_index("run_id")[facts]
    known = set(stored)
    for item in tables.overlays:
        if item["run_id"] not in runs.index:
            continue
        name, reference, bound = runs.loc[item["run_id"]]
        if name in known:
            continue
        known.add(name)
        source, target = np.asarray(item["source"], float), np.asarray(item["target"], float)
        pairs = np.empty((0, 2), int)
        if isinstance(reference, str) and reference:
            pose = np.array(json.loads(reference))
            pairs = mutual_nearest(apply_pose(pose, source), target, float(bound))
        yield name, {
            "source": rounded(source).tolist(), "target": rounded(target).tolist(),
            "pairs": np.asarray(pairs).tolist(), "kind": NEAREST,
        }  # fmt: skip
