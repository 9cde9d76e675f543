"""Laser scans: `.las`, `.laz` and `.e57`, read by packages that need not be installed."""

from __future__ import annotations

import importlib
import io
import struct
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from dcreg.io.arrays import loaded
from dcreg.io.mesh import check_count
from dcreg.io.text import Points, fail, listing

# Layout of LAS files: places in the header, bytes.
SIZES_AT, FORMAT_AT = 94, 104
SMALLEST_RECORD = 54
IS_COMPRESSED = 0x80  # in the number of the format


def read_las(stream: BinaryIO, _: str | None) -> Points:
    """Read the points of a LAS file; LAZ is its compressed form."""
    laspy = _package("laspy", "las")
    if Path(stream.name).suffix.lower() == ".laz":
        _package("lazrs", "las")  # laspy calls it
    announced, points = loaded(stream, partial(_las, laspy))
    check_count(announced, len(points))
    return Points(points)


def _las(laspy: Any, stream: BinaryIO) -> tuple[int, np.ndarray]:
    """Return the number of points in the header, and the points."""
    _check_counts(stream)
    stream.seek(0)
    one_thread = laspy.LazBackend.Lazrs  # with several, lazrs aborts the process on some damage
    try:
        with laspy.open(stream, closefd=False, read_evlrs=False, laz_backend=one_thread) as file:
            found = file.read_points(-1)
            # scaled integers plus an offset, as 8-byte numbers
            return file.header.point_count, np.column_stack([found.x, found.y, found.z])
    except BaseException as error:
        if type(error).__name__ == "PanicException":  # of lazrs; not an Exception
            raise ValueError(str(error)) from None
        raise


def _check_counts(stream: BinaryIO) -> None:
    """Refuse damaged counts: with too many records laspy loops, with too many chunks lazrs aborts."""
    size, start, n_records = _numbers(stream, SIZES_AT, "<HII")
    if n_records * SMALLEST_RECORD > max(0, start - size):
        raise ValueError(f"its {n_records} records do not fit before the points")
    (kind,) = _numbers(stream, FORMAT_AT, "<B")
    if kind & IS_COMPRESSED:
        end = stream.seek(0, io.SEEK_END)
        (table,) = _numbers(stream, start, "<q")
        if table == -1:  # of a file that was written in one go
            (table,) = _numbers(stream, end - 8, "<q")
        _, n_chunks = _numbers(stream, table, "<II")
        if n_chunks > end:
            raise ValueError(f"it is too short for {n_chunks} chunks")


def _numbers(stream: BinaryIO, place: int, layout: str) -> tuple[int, ...]:
    stream.seek(place)
    data = stream.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise ValueError("it is cut off")
    return struct.unpack(layout, data)


def read_e57(stream: BinaryIO, key: str | None) -> Points:
    """Read scan `key` of an E57 file, or all its scans, in the common coordinates of the file."""
    pye57 = _package("pye57", "e57")
    scans = loaded(stream, partial(_scans, pye57.E57, key=key))
    if key is not None and key not in scans:
        fail(f"has no scan '{key}'", f"choose one of: {listing(list(scans))}")
    found = [points for points in scans.values() if points is not None]
    return Points(np.concatenate(found) if found else np.empty((0, 3)))


def _scans(open_file: Any, stream: BinaryIO, key: str | None) -> dict[str, np.ndarray | None]:
    """Return the valid points of each scan, but load only scan `key` if one is given."""
    with open_file(stream.name) as file:
        names = map(str, range(file.scan_count))
        return {name: _scan(file, int(name)) if key in (None, name) else None for name in names}


def _scan(file: Any, index: int) -> np.ndarray:
    """Return the points of a scan; the reader moves them by the pose of the scan."""
    columns = file.read_scan(index, ignore_missing_fields=True)
    return np.column_stack([columns[f"cartesian{axis}"] for axis in "XYZ"])


def _package(name: str, extra: str) -> Any:
    """Return an imported package, or say how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        fail(
            f"cannot be read without the package {name}, which is not installed",
            f"install it with: pip install 'dcreg[{extra}]'",
        )
