"""Attributes of points from text and NumPy files, and colours or intensities from PLY and PCD files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dcreg.io.arrays import read_npy
from dcreg.io.mesh import pcd_layout, pcd_records, ply_layout, ply_records, ply_rows, text_body
from dcreg.io.points import Reader, loaded_file
from dcreg.io.text import Points, fail, lines_of, listing, naming, numbers_of, rows_of

# Names in PLY and PCD files, in the order of preference; those of intensities vary.
COLOURS = [
    ["red", "green", "blue"],
    ["r", "g", "b"],
    ["diffuse_red", "diffuse_green", "diffuse_blue"],
]
INTENSITIES = ["intensity", "scalar_intensity", "scalar_Intensity", "reflectance"]
PACKED = ["rgb", "rgba"]  # one field of a PCD file: red, green and blue in its three lowest bytes


def read_attributes(path: str | Path) -> np.ndarray:
    """Read the attributes of the points of a cloud, for `dcreg.Attributes`.

    Parameters
    ----------
    path : str or Path
        A ``.txt`` or ``.csv`` file with the same number of values in each line, or a ``.npy`` file. From
        a ``.ply`` or ``.pcd`` file, the colours of the points, from 0 to 1, are read or, if there are
        none, their intensities.

    Returns
    -------
    (n, f) float64 array

    Raises
    ------
    InputError
        If the file cannot be read, or does not hold one row of numbers per point.
    """
    path = Path(path)
    with naming(path):
        values = loaded_file(path, None, ATTRIBUTE_READERS).array
        if values.ndim not in (1, 2) or not values.size:
            fail(f"the array has shape {values.shape}", "give one number or one row per point")
        return np.asarray(values, dtype=np.float64).reshape(len(values), -1)


def _read_rows(stream: BinaryIO, _: str | None) -> Points:
    """Read the same number of values from each line."""
    rows = list(rows_of(lines_of(stream.read())))
    width = len(rows[0][1]) if rows else 0
    return numbers_of(rows, range(width), width)


def _read_ply(stream: BinaryIO, _: str | None) -> Points:
    content = stream.read()
    ply = ply_layout(content)
    properties = ply.vertex.properties
    columns = _chosen([each.name for each in properties])
    if ply.order:
        table = ply_records(content, ply)
        values = np.column_stack([table[f"{column}"] for column in columns])
    else:
        values = numbers_of(ply_rows(content, ply), columns, len(properties)).array
    return Points(_scaled(values, properties[columns[0]].type))


def _read_pcd(stream: BinaryIO, _: str | None) -> Points:
    content = stream.read()
    pcd = pcd_layout(content)
    packed = [pcd.names.index(name) for name in PACKED if name in pcd.names]
    columns = packed[:1] or _chosen(pcd.names)
    sizes = {pcd.types[column].base.itemsize for column in packed[:1]}
    if any(pcd.types[column].shape != (1,) for column in columns) or sizes - {4}:
        fail("its colours or intensities hold several or long values", "export one of 4 bytes each")
    types = [pcd.types[column].base for column in columns]
    if pcd.kind == "ascii":
        body = text_body(content, pcd.start, 0, pcd.n_points)
        values = numbers_of(body, [pcd.first[column] for column in columns], pcd.first[-1]).array
        table = [values[:, at].astype(kind) for at, kind in enumerate(types)]
    else:
        records = pcd_records(content, pcd)
        table = [records[f"{column}"].reshape(len(records)) for column in columns]
    if not packed:
        return Points(_scaled(np.column_stack(table), types[0].str))
    bits = np.ascontiguousarray(table[0]).view("<u4")  # floats hold the same bits
    return Points(np.column_stack([bits >> shift & 255 for shift in (16, 8, 0)]) / 255.0)


def _chosen(names: Sequence[str]) -> list[int]:
    """Return the places of the colours, or that of the intensity."""
    for wanted in (*COLOURS, *([name] for name in INTENSITIES)):
        if set(wanted) <= set(names):
            return [names.index(name) for name in wanted]
    fail(
        f"points have no colours and no intensity (properties: {listing(names)})",
        "give the attributes as a text file with one row per point",
    )


def _scaled(values: np.ndarray, kind: str) -> np.ndarray:
    """Return colours from 0 to 1; intensities have no common range and stay as they are."""
    is_colour, dtype = values.shape[1] == 3, np.dtype(kind)
    return values / np.iinfo(dtype).max if is_colour and dtype.kind in "iu" else values


ATTRIBUTE_READERS: dict[str, Reader] = {
    **{".txt": _read_rows, ".csv": _read_rows, ".npy": read_npy},
    **{".ply": _read_ply, ".pcd": _read_pcd},
}
