"""PCD files (Point Cloud Library), ascii, binary or compressed."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dcreg.io.common import EXPORT, fail
from dcreg.io.headed import axis_columns, binary_body, read_header, text_body
from dcreg.io.text import numbers_of


@dataclass(frozen=True)
class _Field:
    name: str
    dtype: np.dtype  # an array of `count` numbers

    @property
    def count(self) -> int:
        return self.dtype.shape[0]


def read_pcd(path: Path, _: str | None) -> np.ndarray:
    """The points of a PCD file."""
    content = path.read_bytes()
    rows, start = read_header(path, content, "DATA")
    header = {values[0].upper(): values[1:] for _, values in rows}
    fields, n_points = _fields(path, header), _count(path, header)
    columns = axis_columns(path, [field.name for field in fields])
    if any(fields[column].count != 1 for column in columns):
        fail(path, "its x, y or z hold several values per point", EXPORT)
    match header["DATA"]:
        case ["ascii"]:
            body = text_body(path, content, start, 0, n_points)
            # A field with a count above one fills several text columns.
            first = np.cumsum([0] + [field.count for field in fields]).tolist()
            return numbers_of(path, body, [first[column] for column in columns], first[-1])
        case ["binary"]:
            record = np.dtype([(f"{i}", field.dtype) for i, field in enumerate(fields)])
            points = binary_body(path, content, start, record, n_points, columns)
        case ["binary_compressed"]:
            points = _unpacked(path, content, start, fields, n_points, columns)
        case other:
            remedy = "use ascii, binary or binary_compressed"
            fail(path, f"unknown DATA kind '{' '.join(other)}'", remedy)
    return points


def _fields(path: Path, header: dict[str, list[str]]) -> list[_Field]:
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    codes = {"F": "f", "I": "i", "U": "u"}
    try:
        columns = zip(names, header["TYPE"], header["SIZE"], counts, strict=True)
        return [
            _Field(name, np.dtype((f"<{codes[kind]}{int(size)}", (int(count),))))
            for name, kind, size, count in columns
        ]
    except (KeyError, ValueError, TypeError):
        fail(path, "FIELDS, SIZE, TYPE and COUNT of the header do not fit together", EXPORT)


def _count(path: Path, header: dict[str, list[str]]) -> int:
    try:
        stated = _natural(header["POINTS"][0]) if "POINTS" in header else None
        if stated is not None and "WIDTH" not in header:
            return stated
        width, height = _natural(header["WIDTH"][0]), _natural(header.get("HEIGHT", ["1"])[0])
    except (KeyError, IndexError, ValueError):
        fail(path, "the header states no valid number of points", EXPORT)
    if stated not in (None, width * height):
        fail(
            path,
            f"the header states POINTS {stated}, but WIDTH x HEIGHT = {width} x {height}",
            "correct the header or " + EXPORT,
        )
    return width * height


def _natural(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(text)
    return int(text)


def _unpacked(
    path: Path, content: bytes, start: int, fields: list[_Field], n_points: int, columns: list[int]
) -> np.ndarray:
    """Coordinates from compressed data: one field after the other, each for all points."""
    ends = np.cumsum([0] + [field.dtype.itemsize * n_points for field in fields]).tolist()
    try:
        packed_size, size = struct.unpack_from("<II", content, start)
        packed = content[start + 8 : start + 8 + packed_size]
        data = lzf_decompress(packed, size) if size else b""
    except (struct.error, IndexError):
        fail(path, "the compressed data are damaged or cut off", EXPORT)
    if len(packed) != packed_size or len(data) != size or size != ends[-1]:
        fail(path, "the compressed data are damaged or cut off", EXPORT)
    axes = [np.frombuffer(data, fields[c].dtype.base, n_points, ends[c]) for c in columns]
    return np.column_stack(axes)


def lzf_decompress(packed: bytes, size: int) -> bytes:
    """Unpack LZF: literal runs, and copies of earlier output that may overlap their own end."""
    out = bytearray()
    i = 0
    while i < len(packed) and len(out) <= size:
        control = packed[i]
        i += 1
        if control < 32:
            out += packed[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[i]
            i += 1
        distance = ((control & 31) << 8) + packed[i] + 1
        i += 1
        if distance > len(out):
            raise IndexError("reference before the start")
        chunk = bytes(out[-distance:])
        repeats = -(-(length + 2) // distance)
        out += (chunk * repeats)[: length + 2]
    return bytes(out)
