"""Photographs of four objects with manually marked points: register edges, or the marks."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from data.contract import Axis, DataError, RawInstance, RecordedDataset
from data.fetch import fetch
from data.photographs import edge_points, given_pairs, half_turn, near_pairs
from data.sampling import reference_pose
from dcreg.problem import apply_pose

LEVELS = (1.0, 2.0, 3.0, 4.0, 5.0)


@lru_cache(maxsize=4)
def _marks(path: Path) -> dict[str, np.ndarray]:
    return {name: marks.astype(float) for name, marks in loadmat(path).items() if name[0] == "X"}


class Loader(RecordedDataset):
    """``car``, ``motobike``, ``revolver``, ``eiffel``: the first photograph, rotated, to the others."""

    def shapes(self) -> list[str]:
        return list(self.card.parameters["shapes"])

    def tests(self) -> dict[str, Axis]:
        axis = Axis(LEVELS, LEVELS, "photograph", 1)
        return {"canny": axis, "marked": axis}

    def has(self, shape: str, test: str, level: float, trial: int) -> bool:
        """Whether the instance exists: one photograph has marks only."""
        known = {file.path for file in self.card.files}
        return known.issuperset(self._paths(shape, test, level))

    def files(self, shape: str, test: str, level: float, trial: int) -> list[Path]:
        """Return the files of the marks, the first photograph and, for edges, the other one."""
        return [fetch(self.card.file(path)) for path in self._paths(shape, test, level)]

    def takes_n_points(self, test: str) -> bool:
        return test != "marked"

    def load(
        self, shape: str, test: str, level: float, trial: int, n_points: int | None
    ) -> RawInstance:
        marks_path, *photographs = self.files(shape, test, level, trial)
        first, other = (_marks(marks_path)[f"X{number}"] for number in self._numbers(shape, level))
        turn = half_turn(photographs[0])
        marked = apply_pose(turn, first), other[: len(first)]
        rows = np.column_stack([np.arange(len(first))] * 2)
        scale_range = tuple(self.card.parameters["scale_range"])
        T_true = reference_pose(*marked, rows, scale_range)
        if test == "marked":
            if n_points is not None:
                raise DataError(
                    f"dataset {self.name}: marks have a fixed number of points; remove n_points"
                )
            return RawInstance(marked[0], other.copy(), rows, T_true, scale_range)
        sigma, count = self.card.parameters["sigma"], n_points or self.card.parameters["n_points"]
        edges = [edge_points(path, sigma, count) for path in photographs]
        source, target = apply_pose(turn, edges[0]), edges[1].copy()
        pairs = near_pairs(T_true, source, target)
        return RawInstance(
            source, target, pairs, T_true, scale_range,
            n_inliers=given_pairs(source, target), marks=marked,
        )  # fmt: skip

    def _paths(self, shape: str, test: str, level: float) -> list[str]:
        first, other = self._numbers(shape, level)
        names = [f"data_{shape}_match.mat", f"{first}.jpg"]
        if test == "canny":
            names.append(f"{other}.jpg")
        return [f"images/lian-apm/{shape}/{name}" for name in names]

    def _numbers(self, shape: str, level: float) -> tuple[int, int]:
        entry = self.card.parameters["shapes"][shape]
        return entry["first"], entry["others"][int(level) - 1]
