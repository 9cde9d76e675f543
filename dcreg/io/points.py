"""`read_points`: one reader per file format, and what must hold whatever the format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dcreg.io.arrays import read_mat, read_npy, read_npz
from dcreg.io.common import DIMENSIONS, fail
from dcreg.io.off import read_off
from dcreg.io.pcd import read_pcd
from dcreg.io.ply import read_ply
from dcreg.io.text import read_text, read_xyz

# Every reader takes the path and the name of an array, which only archives of arrays have.
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
        If the file is missing, damaged, empty, not finite, of another dimension or ambiguous.
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
    """Take ``file.npz:key`` apart; an explicit `key` and a file of that very name win."""
    text = str(path)
    stem, _, name = text.rpartition(":")
    if key is None and Path(stem).suffix.lower() in READERS and not Path(text).exists():
        return Path(stem), name
    return Path(text), key


def _checked(path: Path, points: np.ndarray) -> np.ndarray:
    """What must hold for every format, whatever its reader has checked."""
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
