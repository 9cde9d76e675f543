"""Point clouds, feasible pairs and matches from files of every format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dcreg.io.arrays import read_mat, read_npy, read_npz
from dcreg.io.mesh import read_off, read_pcd, read_ply
from dcreg.io.text import DIMENSIONS, fail, read_text, read_xyz

# Every reader takes the path and the name of an array; only archives have named arrays.
READERS: dict[str, Callable[[Path, str | None], np.ndarray]] = {
    ".txt": read_text,
    ".csv": read_text,
    ".xyz": read_xyz,
    ".npy": read_npy,
    ".npz": read_npz,
    ".mat": read_mat,
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".off": read_off,
}
KEYED_SUFFIXES = (".npz", ".mat")
MAX_ROWS = 2**31  # of a cloud


def read_points(path: str | Path, *, key: str | None = None) -> np.ndarray:
    """Read a point cloud.

    Parameters
    ----------
    path : str or Path
        A ``.txt .csv .xyz .npy .npz .mat .ply .pcd .off`` file. For ``.npz`` and ``.mat`` the
        array may be named as ``file.npz:key``.
    key : str, optional
        Name of the array in an ``.npz`` or ``.mat`` file; needed only if several arrays qualify.

    Returns
    -------
    (n, d) float64 array
        One point per row, d = 2 or 3, all values finite.

    Raises
    ------
    InputError
        If the file is missing, damaged, empty, not finite, ambiguous or of the wrong dimension.
    """
    path, key = _split_key(path, key)
    suffix = path.suffix.lower()
    if path.is_dir():
        fail(path, "is a folder", "give the path of a point file")
    if suffix not in READERS:
        fail(path, f"unknown extension '{path.suffix}'", f"use one of: {' '.join(READERS)}")
    if key is not None and suffix not in KEYED_SUFFIXES:
        fail(path, f"key '{key}' given, but {suffix} files hold no named arrays", "drop the key")
    try:
        points = READERS[suffix](path, key)
    except FileNotFoundError:
        fail(path, "no such file", f"check the path (working folder: {Path.cwd()})")
    except OSError as error:
        fail(path, f"cannot be read: {error.strerror or error}", "check permissions and the disk")
    return _checked(path, points)


def _split_key(path: str | Path, key: str | None) -> tuple[Path, str | None]:
    """Split ``file.npz:key``, unless `key` is given or a file of this full name exists."""
    text = str(path)
    stem, _, name = text.rpartition(":")
    if key is None and Path(stem).suffix.lower() in READERS and not Path(text).exists():
        return Path(stem), name
    return Path(text), key


def _checked(path: Path, points: np.ndarray) -> np.ndarray:
    """Return the points as floats; check what every format requires."""
    if points.ndim != 2 or points.shape[1] not in DIMENSIONS:
        remedy = "points go in rows, with 2 or 3 columns"
        if points.ndim == 2 and points.shape[0] in DIMENSIONS:
            remedy += " (this array looks transposed)"
        fail(path, f"wrong dimension: the array has shape {points.shape}", remedy)
    if len(points) == 0:
        fail(path, "holds no points", "give a file with at least one point")
    points = np.ascontiguousarray(points, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        fail(
            path,
            f"NaN or infinity in {bad.size} of {len(points)} points, "
            f"first in point {bad[0]} (from 0): {points[bad[0]].tolist()}",
            "remove these points",
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
        If the file cannot be read, holds other values than pairs, or names a row that does not exist.
    """
    path = Path(path)
    pairs = _read_table(path)
    feasible: list[list[int]] = [[] for _ in range(n_source)]
    for i, j in pairs.tolist():
        if not 0 <= i < n_source:
            fail(path, f"{i:g} is not a source row", f"use rows from 0 to {n_source - 1}")
        if not 0 <= j < MAX_ROWS:
            fail(path, f"{j:g} is not a target row", "use row numbers, from 0")
        feasible[int(i)].append(int(j))
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
        If the file cannot be read, holds other values than pairs, or names a row that does not exist.
    """
    path = Path(path)
    pairs = _read_table(path)
    for column, (cloud, count) in enumerate((("source", n_source), ("target", n_target))):
        beyond = (pairs[:, column] < 0) | (pairs[:, column] >= count)
        if beyond.any():
            row = pairs[np.argmax(beyond), column]
            fail(path, f"{row:g} is not a {cloud} row", f"use rows from 0 to {count - 1}")
    return pairs.astype(np.int64)


def _read_table(path: Path) -> np.ndarray:
    """Read an (N, 2) table of whole numbers."""
    pairs = read_points(path)
    if pairs.shape[1] != 2 or (pairs != np.round(pairs)).any():
        fail(path, "not a table of pairs", "give two columns of row numbers, from 0")
    return pairs
