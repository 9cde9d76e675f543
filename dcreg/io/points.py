"""Point clouds, feasible pairs and matches from files of every format."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dcreg.io.arrays import read_mat, read_npy, read_npz
from dcreg.io.mesh import read_off, read_pcd, read_ply
from dcreg.io.scans import read_e57, read_las
from dcreg.io.text import DIMENSIONS, Points, fail, naming, read_column, read_text

# Every reader takes the file and a key, the name of an array or the number of a scan.
Reader = Callable[[BinaryIO, str | None], Points]
READERS: dict[str, Reader] = {
    ".txt": read_text,
    ".csv": read_text,
    ".xyz": partial(read_text, any_width=True),
    ".npy": read_npy,
    ".npz": read_npz,
    ".mat": read_mat,
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".off": read_off,
    ".las": read_las,
    ".laz": read_las,
    ".e57": read_e57,
}
WEIGHT_READERS: dict[str, Reader] = {".txt": read_column, ".csv": read_column, ".npy": read_npy}
KEYED_SUFFIXES = (".npz", ".mat", ".e57")
MAX_ROWS = 2**31  # of a cloud


def read_points(
    path: str | Path, *, key: str | None = None, keep_invalid: bool = False
) -> np.ndarray:
    """Read a point cloud.

    Parameters
    ----------
    path : str or Path
        A ``.txt .csv .xyz .npy .npz .mat .ply .pcd .off .las .laz .e57`` file. For ``.npz``,
        ``.mat`` and ``.e57`` the key may follow the name: ``file.npz:key``.
    key : str, optional
        Name of the array in an ``.npz`` or ``.mat`` file; needed only if several arrays qualify. In an
        ``.e57`` file the number of a scan, from 0; by default all scans are read, in the coordinates
        that they share.
    keep_invalid : bool
        Return points with NaN or infinity as well. By default, they are an error.

    Returns
    -------
    (n, d) float64 array
        One point per row, d = 2 or 3; all values are finite, unless `keep_invalid` is set.

    Raises
    ------
    InputError
        If the file is missing, damaged, empty, not finite, ambiguous or of the wrong dimension, or if a
        package that reads it is not installed.
    """
    path, key = split_key(path, key)
    # NaN and infinity are found later, also those that a conversion of numbers makes
    with naming(path), np.errstate(all="ignore"):
        return _checked(loaded_file(path, key, READERS), keep_invalid)


def read_weights(path: str | Path) -> np.ndarray:
    """Read the weights of the points of a cloud, for `dcreg.PointWeights`.

    Parameters
    ----------
    path : str or Path
        A ``.txt`` or ``.csv`` file with one number per line, or a ``.npy`` file.

    Returns
    -------
    (n,) float64 array

    Raises
    ------
    InputError
        If the file cannot be read, or does not hold one number per point.
    """
    path = Path(path)
    with naming(path):
        weights = loaded_file(path, None, WEIGHT_READERS).array
        if weights.ndim != 1 or not weights.size:
            fail(f"the array has shape {weights.shape}", "give one number per point")
        return np.asarray(weights, dtype=np.float64)


def loaded_file(path: Path, key: str | None, readers: dict[str, Reader]) -> Points:
    """Return what a file holds, by the reader of its extension."""
    suffix = path.suffix.lower()
    if path.is_dir():
        fail("is a folder", "give the path of a point file")
    if suffix not in readers:
        fail(f"unknown extension '{path.suffix}'", f"use one of: {' '.join(readers)}")
    if key is not None and suffix not in KEYED_SUFFIXES:
        fail(f"key '{key}' given, but {suffix} files have none", "drop the key")
    try:
        with path.open("rb") as stream:
            return readers[suffix](stream, key)
    except FileNotFoundError:
        fail("no such file", f"check the path (working folder: {Path.cwd()})")
    except OSError as error:
        fail(f"cannot be read: {error.strerror or error}", "check permissions and the disk")


def split_key(path: str | Path, key: str | None) -> tuple[Path, str | None]:
    """Split ``file.npz:key``, unless `key` is given or a file of this full name exists."""
    text = str(path)
    stem, _, name = text.rpartition(":")
    if key is None and Path(stem).suffix.lower() in READERS and not Path(text).exists():
        return Path(stem), name
    return Path(text), key


def _checked(found: Points, keep_invalid: bool) -> np.ndarray:
    """Return the points as floats; check what every format requires."""
    points = found.array
    if points.ndim != 2 or points.shape[1] not in DIMENSIONS:
        remedy = "points go in rows, with 2 or 3 columns"
        if points.ndim == 2 and points.shape[0] in DIMENSIONS:
            remedy += " (this array looks transposed)"
        fail(f"wrong dimension: the array has shape {points.shape}", remedy)
    if len(points) == 0:
        fail("holds no points", "give a file with at least one point")
    points = np.ascontiguousarray(points, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size and not keep_invalid:
        first = f"first in point {bad[0]} (from 0): {points[bad[0]].tolist()}"
        if found.lines is not None:
            first = f"first in line {found.lines[bad[0]]}"
        fail(
            f"NaN or infinity in {bad.size} of {len(points)} points, {first}",
            "remove these points, or give --drop-invalid to leave them out",
        )
    return points


def read_candidates(path: str | Path, n_source: int) -> list[list[int]]:
    """Read feasible pairs for the argument `candidates` of `dcreg.register`.

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
        If the file cannot be read, has values that are not pairs, or names a row that does not exist.
    """
    feasible: list[list[int]] = [[] for _ in range(n_source)]
    for i, j in _read_pairs(path, n_source, None).tolist():
        feasible[i].append(j)
    return feasible


def read_matches(path: str | Path, n_source: int, n_target: int) -> np.ndarray:
    """Read a list of matches for the argument `matches` of `dcreg.register_matches`.

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
        If the file cannot be read, has values that are not pairs, or names a row that does not exist.
    """
    return _read_pairs(path, n_source, n_target)


def _read_pairs(path: str | Path, n_source: int, n_target: int | None) -> np.ndarray:
    """Read an (N, 2) table of row numbers; without `n_target`, a target row may be any."""
    pairs = read_points(path, keep_invalid=True)
    with naming(Path(path)):
        if pairs.shape[1] != 2 or not np.isfinite(pairs).all() or (pairs != np.round(pairs)).any():
            fail("not a table of pairs", "give two columns of row numbers, from 0")
        clouds = ("source", n_source), ("target", n_target)
        for rows, (cloud, count) in zip(pairs.T, clouds, strict=True):
            beyond = rows[(rows < 0) | (rows >= (count or MAX_ROWS))]
            if beyond.size:
                known = f"rows from 0 to {count - 1}" if count else "row numbers, from 0"
                fail(f"{beyond[0]:g} is not a {cloud} row", f"use {known}")
    return pairs.astype(np.int64)
