"""Stock loaders: a dataset that uses one of them needs a card only."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from data.contract import (
    Axis,
    Card,
    DataError,
    Dataset,
    PrototypeDataset,
    RawInstance,
    RecordedDataset,
)
from data.fetch import fetch
from data.pairs import CloudPairs
from data.parameters import Length, Parameters, Points, file_of, parameters_of
from data.photographs import Photographs
from data.sampling import farthest_points
from data.scans import scan_instance
from dcreg.io import read_points

DEFAULT_POINTS_3D = 100


@lru_cache(maxsize=16)
def _read(path: Path, skip_rows: int) -> np.ndarray:
    return np.loadtxt(path, skiprows=skip_rows) if skip_rows else read_points(path)


class PointFile(Parameters):
    file: str  # a path among the card's files
    skip_rows: Annotated[int, Field(ge=0, strict=True)] = 0  # header lines


class PointParameters(Parameters):
    shapes: Annotated[dict[str, PointFile], Field(min_length=1)]


class PointFiles(PrototypeDataset):
    """Prototypes with one file each, in any format that ``dcreg register`` reads.

    Card parameters: ``shapes``, a mapping from name to ``file`` (a path among the card's files)
    and, for text with a header, ``skip_rows``.
    """

    def __init__(self, card: Card) -> None:
        super().__init__(card)
        self.entries = parameters_of(card, PointParameters).shapes
        for shape, entry in self.entries.items():
            file_of(card, entry.file, f"shapes.{shape}.file")

    def shapes(self) -> list[str]:
        return list(self.entries)

    def fetch(self, shape: str, test: str = "", level: float = 0.0, trial: int = 0) -> list[Path]:
        self._known("shape", shape, self.shapes())
        return [fetch(self.card.file(self.entries[shape].file))]

    def points(self, shape: str, n_points: int | None = None) -> np.ndarray:
        points = _read(self.fetch(shape)[0], self.entries[shape].skip_rows)
        if n_points is None:
            n_points = len(points) if self.dim(shape) == 2 else DEFAULT_POINTS_3D
        if n_points > len(points):
            raise DataError(
                f"dataset {self.name}: shape {shape} has {len(points)} points, "
                f"fewer than n_points={n_points}; lower n_points"
            )
        if n_points == len(points):
            return points.copy()
        return points[farthest_points(points, n_points)]


class ScanParameters(Parameters):
    shape: str
    source: str  # this and the next two are paths among the card's files
    target: str
    transform: str
    voxel: Length
    tolerance: Length
    n_points: Points


class ScanPair(RecordedDataset):
    """One pair of scans with its pose: a single test ``pair`` with level 0 and one trial.

    Card parameters: ``shape``, ``source``, ``target``, ``transform`` (paths among the files),
    ``voxel`` and ``tolerance`` in the scans' unit, ``n_points``.
    """

    def __init__(self, card: Card) -> None:
        super().__init__(card)
        self.parameters = given = parameters_of(card, ScanParameters)
        paths = {"source": given.source, "target": given.target, "transform": given.transform}
        self.records = [file_of(card, path, name) for name, path in paths.items()]

    def shapes(self) -> list[str]:
        return [self.parameters.shape]

    def tests(self) -> dict[str, Axis]:
        return {"pair": Axis(levels=(0.0,), values=(0.0,), label="-", n_trials=1)}

    def files(self, shape: str, test: str, level: float, trial: int) -> list[Path]:
        return [fetch(file) for file in self.records]

    def load(
        self, shape: str, test: str, level: float, trial: int, n_points: int | None
    ) -> RawInstance:
        source, target, pose = self.files(shape, test, level, trial)
        return scan_instance(
            _read(source, 0),
            _read(target, 0),
            np.loadtxt(pose),
            voxel=self.parameters.voxel,
            n_points=n_points or self.parameters.n_points,
            tolerance=self.parameters.tolerance,
            info={},
        )


STOCK: dict[str, type[Dataset]] = {
    "points": PointFiles,
    "scan_pair": ScanPair,
    "pairs": CloudPairs,
    "photographs": Photographs,
}
