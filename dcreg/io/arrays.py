"""NumPy arrays and archives of named arrays: `.npy`, `.npz`, `.mat`; pickles are never loaded."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from dcreg.io.text import DIMENSIONS, fail, listing

# Named arrays of an archive; None stands for an entry that is not a plain array or was not requested.
Arrays = dict[str, np.ndarray | None]


def read_npy(path: Path, _: str | None) -> np.ndarray:
    """Read the array of an ``.npy`` file."""
    array = _loaded(path, partial(np.load, allow_pickle=False))
    if not isinstance(array, np.ndarray):
        fail(path, "holds several arrays", "rename it to .npz")
    return _real(path, array)


def read_npz(path: Path, key: str | None) -> np.ndarray:
    """Read the array `key` of an ``.npz`` file, or its only point cloud."""
    arrays = _loaded(path, partial(_npz_arrays, key=key))
    if arrays is None:
        fail(path, "holds a single array", "rename it to .npy")
    return _pick(path, arrays, key)


def _npz_arrays(stream: BinaryIO, key: str | None) -> Arrays | None:
    """Return all names, but load only the array `key` if one is given: archives can be large."""
    archive = np.load(stream, allow_pickle=False)
    if isinstance(archive, np.ndarray):
        return None
    return {name: _member(archive, name) if key in (None, name) else None for name in archive.files}


def _member(archive: np.lib.npyio.NpzFile, name: str) -> np.ndarray | None:
    try:
        return archive[name]
    except ValueError as error:
        if "allow_pickle" in str(error):
            return None
        raise


def read_mat(path: Path, key: str | None) -> np.ndarray:
    """Read the array `key` of a MATLAB file up to v7, or its only point cloud."""
    from scipy.io import loadmat

    content = _loaded(path, loadmat)
    arrays: Arrays = {
        name: value if isinstance(value, np.ndarray) else None
        for name, value in content.items()
        if not name.startswith("__")
    }
    return _pick(path, arrays, key)


def _loaded(path: Path, load: Callable[[BinaryIO], Any]) -> Any:
    """Load a file with a reader of another library, which may raise anything on damage."""
    with path.open("rb") as stream:
        try:
            return load(stream)
        except Exception as error:
            # MATLAB's default for large data, v7.3, is HDF5, which SciPy does not read
            remedy = "save it again" + " with: save -v7" * (path.suffix.lower() == ".mat")
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            fail(path, f"is not a readable {path.suffix} file ({reason})", remedy)


def _pick(path: Path, arrays: Arrays, key: str | None) -> np.ndarray:
    """Return the array called `key`, or the only one that can be a point cloud."""
    names = listing(list(arrays))
    if key is not None:
        if key not in arrays:
            fail(path, f"has no array '{key}'", f"choose one of: {names}")
        return _real(path, arrays[key], key)
    clouds = {name: array for name, array in arrays.items() if _is_cloud(array)}
    if not clouds:
        fail(path, "holds no numeric array with 2 or 3 columns", f"arrays found: {names}")
    if len(clouds) > 1:
        first = next(iter(clouds))
        fail(
            path,
            f"is ambiguous, several arrays can be point clouds: {listing(list(clouds))}",
            f"name one, for example '{path.name}:{first}' or --source-key / --target-key {first}",
        )
    return _real(path, next(iter(clouds.values())))


def _is_cloud(array: np.ndarray | None) -> bool:
    return (
        array is not None
        and array.dtype.kind in "fiu"
        and array.ndim == 2
        and array.shape[1] in DIMENSIONS
    )


def _real(path: Path, array: np.ndarray | None, key: str | None = None) -> np.ndarray:
    what = "the array" if key is None else f"array '{key}'"
    if array is None:
        fail(path, f"{what} holds objects, which are not loaded", "store plain numbers")
    if array.dtype.kind not in "fiu":
        fail(path, f"{what} has type {array.dtype}", "store real numbers")
    return array
