"""Run the tests of an experiment on embedded shapes, which need no files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from data import registry
from data.contract import DataError, PrototypeDataset
from workflows.compose import EMBEDDED

DATASET = "embedded"  # it needs no files


def with_stand_ins(content: dict[str, Any]) -> dict[str, Any]:
    """Return a config whose shapes are replaced by embedded ones of the same dimension.

    Recorded data are left out, and so are further shapes once all embedded ones are used.
    """
    entries = [entry for entry in content["datasets"] if isinstance(entry, dict)]
    free = _embedded_shapes()
    datasets = []
    for entry in entries:
        shapes = [free[dim].pop(0) for dim in dims_of(entry) if free[dim]]
        if shapes:
            datasets.append({**entry, "dataset": DATASET, "shapes": shapes})
    name = f"{content['name']}{EMBEDDED}"
    title = f"{content.get('title', '')}, on embedded shapes"
    return {**content, "datasets": datasets, "name": name, "title": title}


def _embedded_shapes() -> dict[int, list[str]]:
    dataset = registry.dataset(DATASET)
    return {dim: [s for s in dataset.shapes() if dataset.dim(s) == dim] for dim in (2, 3)}


def dims_of(entry: dict[str, Any]) -> Iterator[int]:
    """Yield the dimension of each shape of an entry; nothing for recorded data."""
    with suppress(DataError):
        dataset = registry.dataset(str(entry.get("dataset")))
        if isinstance(dataset, PrototypeDataset):
            for shape in entry.get("shapes") or dataset.shapes():
                yield dataset.dim(shape)
