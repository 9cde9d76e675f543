"""The points and normals of a cloud before and after it moves, and the types that hold them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from dcreg.problem import apply_pose, scale_of

# Names of the components of normals in PLY and text, and in PCD.
NORMALS = (["nx", "ny", "nz"], ["normal_x", "normal_y", "normal_z"])
# Numbers of 4 bytes become numbers of 8 if rounding would exceed this share of the extent of the cloud.
MOST_ROUNDING = 1e-6


class Change(NamedTuple):
    """New values of a column, and the rows that change; all others stay as they are."""

    values: np.ndarray
    rows: np.ndarray
    is_wide: bool  # whether numbers of 4 bytes are too short


# From the index of a column to its new values.
Changes = Mapping[int, Change]


@dataclass(frozen=True)
class Move:
    """A pose and the points that it moves. Points with NaN or infinity stay as they are."""

    T: np.ndarray
    points: np.ndarray

    @cached_property
    def valid(self) -> np.ndarray:
        return np.isfinite(self.points).all(axis=1)

    @cached_property
    def moved(self) -> np.ndarray:
        moved, valid = self.points.copy(), self.valid
        moved[valid] = apply_pose(self.T, self.points[valid])
        return moved

    @cached_property
    def is_wide(self) -> bool:
        """Whether numbers of 4 bytes would round the moved points too much."""
        moved = self.moved[self.valid]
        if not len(moved):
            return False
        with np.errstate(all="ignore"):
            rounding = np.spacing(np.abs(moved).max().astype(np.float32))
        return not rounding <= MOST_ROUNDING * np.ptp(moved, axis=0).max()

    def changes(
        self, names: list[str], columns: list[int], column: Callable[[int], np.ndarray]
    ) -> Changes:
        """Return the new values of coordinates and normals.

        Parameters
        ----------
        names : list of str
            Of all columns, as far as the file names them.
        columns : list of int
            The coordinates.
        column : callable
            From the index of a column to its values.
        """
        found = {
            at: Change(values, self.valid, self.is_wide)
            for at, values in zip(columns, self.moved.T, strict=True)
        }
        d = len(columns)
        for components in NORMALS:
            if not set(components[:d]) <= set(names):
                continue
            at = [names.index(name) for name in components[:d]]
            normals = np.column_stack([column(i) for i in at])
            valid = np.isfinite(normals).all(axis=1)
            normals[valid] = normals[valid] @ (self.T[:d, :d] / scale_of(self.T)).T
            found |= {
                i: Change(values, valid, False) for i, values in zip(at, normals.T, strict=True)
            }
        return found


def new_type(old: np.dtype, change: Change) -> np.dtype:
    """Return the type of a changed column, in the byte order of the old one."""
    is_kept = old.kind == "f" and old.itemsize > (4 if change.is_wide else 2)
    return old if is_kept else np.dtype("f8").newbyteorder(old.byteorder)
