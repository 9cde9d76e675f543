"""NumPy arrays and archives of named arrays: `.npy`, `.npz`, `.mat`; pickles are never loaded."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from dcreg.io.text import DIMENSIONS, Points, fail, listing

if TYPE_CHECKING:
    from dcreg.io.matlab import Arrays


def read_npy(stream: BinaryIO, _: str | None) -> Points:
    """Read the array of an ``.npy`` file."""
    array = loaded(stream, partial(np.load, allow_pickle=False))
    if not isinstance(array, np.ndarray):
        fail("holds several arrays", "rename it to .npz")
    return Points(_real(array))


def read_npz(stream: BinaryIO, key: str | None) -> Points:
    """Read the array `key` of an ``.npz`` file, or its only point cloud."""
    return Points(npz_cloud(stream, key)[1])


def npz_cloud(stream: BinaryIO, key: str | None) -> tuple[str, np.ndarray]:
    """Return the name and the array of the point cloud of an ``.npz`` file."""
    arrays = loaded(stream, partial(_npz_arrays, key=key))
    if arrays is None:
        fail("holds a single array", "rename it to .npy")
    return _pick(stream, arrays, key)


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


def read_mat(stream: BinaryIO, key: str | None) -> Points:
    """Read the array `key` of a MATLAB file up to v7, or its only point cloud."""
    from dcreg.io import matlab  # few calls need it

    return Points(_pick(stream, loaded(stream, matlab.load), key)[1])


def loaded(stream: BinaryIO, load: Callable[[BinaryIO], Any]) -> Any:
    """Load a file with a reader of another library, which may raise anything on damage."""
    try:
        return load(stream)
    except Exception as error:
        suffix = Path(stream.name).suffix
        # MATLAB's default for large data, v7.3, is HDF5, which SciPy does not read
        remedy = "save it again" + " with: save -v7" * (suffix.lower() == ".mat")
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "pickle" in reason:  # NumPy takes any file for one, and advises to load it unsafely
            reason = "it holds objects or no array"
        fail(f"is not a readable {suffix} file ({reason})", remedy)


def _pick(stream: BinaryIO, arrays: Arrays, key: str | None) -> tuple[str, np.ndarray]:
    """Return name and content of the array `key`, or of the only one that can be a point cloud."""
    names = listing(list(arrays))
    if key is not None:
        if key not in arrays:
            fail(f"has no array '{key}'", f"choose one of: {names}")
        return key, _real(arrays[key], key)
    clouds = {name: array for name, array in arrays.items() if _is_cloud(array)}
    if not clouds:
        fail("holds no numeric array with 2 or 3 columns", f"arrays found: {names}")
    first = next(iter(clouds))
    if len(clouds) > 1:
        name = Path(stream.name).name
        fail(
            f"is ambiguous, several arrays can be point clouds: {listing(list(clouds))}",
            f"name one, for example '{name}:{first}' or --source-key / --target-key {first}",
        )
    return first, _real(clouds[first])


def _is_cloud(array: np.ndarray | None) -> bool:
    return (
        array is not None
        and array.dtype.kind in "fiu"
        and array.ndim == 2
        and array.shape[1] in DIMENSIONS
    )


def _real(array: np.ndarray | None, key: str | None = None) -> np.ndarray:
    what = "the array" if key is None else f"array '{key}'"
    if array is None or array.dtype.kind in "OSU":
        kind = "" if array is None else f" (type {array.dtype})"
        fail(f"{what} holds objects or text{kind}, which are not loaded", "store real numbers")
    if array.dtype.kind not in "fiu":
        fail(f"{what} has type {array.dtype}", "store real numbers")
    return array
