"""Feasible pairs and matches from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dcreg.io.common import fail
from dcreg.io.points import read_points

MAX_ROWS = 2**31  # of a cloud


def read_candidates(path: str | Path, n_source: int) -> list[list[int]]:
    """Read feasible pairs, as the argument `candidates` of `dcreg.register` takes them.

    Parameters
    ----------
    path : str or Path
        Two columns, source row and target row, from 0; any format of `read_points`.
    n_source : int
        Number of source points.

    Returns
    -------
    list of list of int
        The target rows of every source point.

    Raises
    ------
    InputError
        If the file cannot be read, holds anything but pairs, or names a source row there is not.
    """
    path = Path(path)
    pairs = _read_table(path)
    feasible: list[list[int]] = [[] for _ in range(n_source)]
    for i, j in pairs.tolist():
        if not 0 <= i < n_source:
            fail(path, f"{i:g} is no source row", f"use rows from 0 to {n_source - 1}")
        if not 0 <= j < MAX_ROWS:
            fail(path, f"{j:g} is no target row", "use row numbers, from 0")
        feasible[int(i)].append(int(j))
    return feasible


def read_matches(path: str | Path, n_source: int, n_target: int) -> np.ndarray:
    """Read a list of matches, as the argument `matches` of `dcreg.register_matches` takes it.

    Parameters
    ----------
    path : str or Path
        Two columns, source row and target row, from 0; any format of `read_points`.
    n_source, n_target : int
        Numbers of points.

    Returns
    -------
    (N, 2) int array
        In the order of the file.

    Raises
    ------
    InputError
        If the file cannot be read, holds anything but pairs, or names a row there is not.
    """
    path = Path(path)
    pairs = _read_table(path)
    for column, (cloud, count) in enumerate((("source", n_source), ("target", n_target))):
        beyond = (pairs[:, column] < 0) | (pairs[:, column] >= count)
        if beyond.any():
            row = pairs[np.argmax(beyond), column]
            fail(path, f"{row:g} is no {cloud} row", f"use rows from 0 to {count - 1}")
    return pairs.astype(np.int64)


def _read_table(path: Path) -> np.ndarray:
    """(N, 2) whole numbers."""
    pairs = read_points(path)
    if pairs.shape[1] != 2 or (pairs != np.round(pairs)).any():
        fail(path, "not a table of pairs", "give two columns of row numbers, from 0")
    return pairs
