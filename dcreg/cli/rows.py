"""Rows of the files of points: those that are searched, if points with NaN or infinity are dropped.

Searches number the points that are left; files of pairs and results number the rows of the point files.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import dcreg
from dcreg.cli import output


@dataclass(frozen=True)
class Rows:
    """The rows of one file that are searched.

    Attributes
    ----------
    kept : (n,) int array
        Rows with finite points, ascending.
    n_rows : int
        Rows of the file.
    """

    kept: np.ndarray
    n_rows: int

    @classmethod
    def of(cls, points: np.ndarray) -> Rows:
        """Return the rows of the finite points."""
        return cls(np.flatnonzero(np.isfinite(points).all(axis=1)), len(points))

    def valid(self, weights: np.ndarray, path: str | None) -> np.ndarray:
        """Return those of the numbers of a file, one per row, that are searched."""
        if len(weights) != self.n_rows:
            raise dcreg.InputError(
                f"{path}: {len(weights)} numbers for {self.n_rows} points; give one per point"
            )
        return weights[self.kept]

    @property
    def n_dropped(self) -> int:
        """Number of rows that are not searched."""
        return self.n_rows - len(self.kept)

    @property
    def places(self) -> np.ndarray:
        """For each row of the file, its row in the search; -1 if it is dropped."""
        places = np.full(self.n_rows, -1)
        places[self.kept] = np.arange(len(self.kept))
        return places


@dataclass(frozen=True)
class CloudRows:
    """The rows of the source and of the target that are searched."""

    source: Rows
    target: Rows

    @classmethod
    def of(cls, *clouds: np.ndarray, names: dict[str, str]) -> CloudRows:
        """Return the rows of the finite points; warn of others, and fail if all points are others.

        Parameters
        ----------
        *clouds : (n, d) arrays
            Source and target.
        names : dict
            The files of ``source`` and ``target``.

        Raises
        ------
        InputError
        """
        rows = [Rows.of(points) for points in clouds]
        for file, each in zip(names.values(), rows, strict=True):
            if not len(each.kept):
                raise dcreg.InputError(
                    f"{file}: all {each.n_rows} points hold NaN or infinity; export the file again"
                )
            if each.n_dropped:
                dropped = f"{each.n_dropped} of {each.n_rows} points"
                output.print_warning(f"{file}: {dropped} hold NaN or infinity and are dropped")
        return cls(*rows)

    def valid(self, source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points that are searched."""
        return source[self.source.kept], target[self.target.kept]

    @property
    def n_dropped(self) -> dict[str, int]:
        """Numbers of dropped points, by their keys in JSON."""
        return {"dropped_source": self.source.n_dropped, "dropped_target": self.target.n_dropped}

    def read_candidates(self, path: str, n_source: int) -> list[list[int]]:
        """Read feasible pairs of rows of the files, and return them for the points that are searched."""
        feasible = dcreg.read_candidates(path, n_source)
        n_rows = self.target.n_rows
        if beyond := [row for rows in feasible for row in rows if row >= n_rows]:
            raise dcreg.InputError(
                f"{path}: {beyond[0]} is not a target row; use rows from 0 to {n_rows - 1}"
            )
        places = self.target.places.tolist()
        return [[places[j] for j in feasible[i] if places[j] >= 0] for i in self.source.kept]

    def read_matches(self, path: str, n_source: int, n_target: int) -> np.ndarray:
        """Read matches of rows of the files, and return those of points that are searched."""
        pairs = dcreg.read_matches(path, n_source, n_target)
        pairs = np.column_stack([self.source.places[pairs[:, 0]], self.target.places[pairs[:, 1]]])
        return pairs[(pairs >= 0).all(axis=1)]

    def in_files(self, results: list[Any]) -> list[Any]:
        """Return results whose pairs are rows of the files."""
        kept = self.source.kept, self.target.kept
        return [
            replace(
                result,
                assignment=np.column_stack(
                    [rows[column] for rows, column in zip(kept, result.assignment.T, strict=True)]
                ),
            )
            for result in results
        ]
