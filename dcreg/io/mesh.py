"""PLY, PCD and OFF files: a header, then points as text or in binary form."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

import numpy as np

from dcreg.io.text import (
    EXPORT,
    Points,
    Row,
    fail,
    lines_of,
    listing,
    natural,
    numbers_of,
    rows_of,
)

CORRECT = "correct the header or " + EXPORT


def _read_header(content: bytes, kind: str, last: str, magic: str = "") -> tuple[list[Row], int]:
    """Return the lines up to the one that starts with `last`, and the offset of the body."""
    rows: list[Row] = []
    start = 0
    while (end := content.find(b"\n", start)) >= 0:
        fields = content[start:end].decode("utf-8", errors="replace").split()
        start = end + 1
        if magic and not rows and fields != [magic]:
            break
        rows.append((len(rows) + 1, fields or ["#"]))
        if fields and fields[0] == last:
            return rows, start
    fail(f"has no complete {kind} header (no line '{last}')", "it may be cut off; " + EXPORT)


def _axis_columns(names: list[str]) -> list[int]:
    """Return the positions of x, y and, if present, z."""
    if "x" not in names or "y" not in names:
        fail(f"points have no x and y (properties: {listing(names)})", EXPORT)
    return [names.index(axis) for axis in "xyz" if axis in names]


def text_body(content: bytes, start: int, skip: int, count: int, after: int = 0) -> list[Row]:
    """Return `count` text rows of the body, which follow `skip` rows and precede `after` rows."""
    lines = lines_of(content[start:])
    rows = list(rows_of(lines, content[:start].count(b"\n") + 1))
    check_count(count, max(0, len(rows) - skip), max(0, len(rows) - skip - after))
    return rows[skip : skip + count]


def binary_body(
    content: bytes, start: int, record: np.dtype, count: int, after: int | None = 0
) -> np.ndarray:
    """Return `count` binary records at `start`, which precede `after` bytes."""
    size = max(0, len(content) - start)
    own = None if after is None else max(0, size - after) // record.itemsize
    check_count(count, size // record.itemsize, own)
    return np.frombuffer(content, record, count, start)


def _columns_of(table: np.ndarray, columns: list[int]) -> Points:
    return Points(np.column_stack([table[f"{column}"].reshape(len(table)) for column in columns]))


def check_count(announced: int, available: int, own: int | None = None) -> None:
    """Refuse a file with fewer points than its header announces, or with more `own` ones."""
    counts = f"the header announces {announced} points, the file holds"
    if available < announced:
        fail(f"is truncated: {counts} {available}", "copy or export the file again")
    if own is not None and own > announced:
        fail(f"{counts} {own}", CORRECT)


# --- PLY ------------------------------------------------------------------------------------------------

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
# Byte order of each format, as NumPy writes it; the text format has none.
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    name: str
    type: str
    length_type: str = ""  # of the length of a list


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_list(self) -> bool:
        return any(prop.length_type for prop in self.properties)

    def record(self, order: str) -> np.dtype:
        """Return the type of one binary entry without lists; its fields are called "0", "1", ..."""
        return np.dtype([(f"{i}", order + p.type) for i, p in enumerate(self.properties)])


class Ply(NamedTuple):
    """Where the vertices of a PLY file are.

    Attributes
    ----------
    order : str
        Byte order as NumPy writes it; empty for text.
    vertex : _Element
    columns : list of int
        The properties x, y and, if present, z.
    header : int
        Length of the header.
    start : int
        Offset of the first vertex in a binary file; in text that of the body.
    skip : int
        Number of rows of text that precede the vertices.
    after : int, optional
        What follows the vertices: rows of text, or bytes; None if only parsing would tell.
    """

    order: str
    vertex: _Element
    columns: list[int]
    header: int
    start: int
    skip: int
    after: int | None


def read_ply(stream: BinaryIO, _: str | None) -> Points:
    """Read the element ``vertex`` of a PLY file."""
    content = stream.read()
    ply = ply_layout(content)
    if ply.order:
        return _columns_of(ply_records(content, ply), ply.columns)
    return numbers_of(ply_rows(content, ply), ply.columns, len(ply.vertex.properties))


def ply_rows(content: bytes, ply: Ply) -> list[Row]:
    """Return the rows of the vertices of a text file."""
    return text_body(content, ply.start, ply.skip, ply.vertex.count, ply.after or 0)


def ply_records(content: bytes, ply: Ply) -> np.ndarray:
    """Return the records of the vertices of a binary file."""
    vertex = ply.vertex
    return binary_body(content, ply.start, vertex.record(ply.order), vertex.count, ply.after)


def ply_layout(content: bytes) -> Ply:
    """Find the vertices of a PLY file."""
    lines, header = _read_header(content, ".ply", "end_header", magic="ply")
    order, elements = _parsed(lines)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        fail("declares no element 'vertex'", "export the file with its points")
    if vertex.has_list:
        fail("its vertices have list properties", "export the points alone")
    columns = _axis_columns([prop.name for prop in vertex.properties])
    at = elements.index(vertex)
    before, behind = elements[:at], elements[at + 1 :]
    if not order:
        skip, rest = (sum(e.count for e in part) for part in (before, behind))
        return Ply(order, vertex, columns, header, header, skip, rest)
    start = header
    for element in before:
        start = _skip_element(content, start, element, order)
    after = (
        None
        if any(element.has_list for element in behind)
        else sum(element.record(order).itemsize * element.count for element in behind)
    )
    return Ply(order, vertex, columns, header, start, 0, after)


def _parsed(header: list[Row]) -> tuple[str, list[_Element]]:
    """Return the byte order and the elements that the header declares."""
    order: str | None = None
    elements: list[_Element] = []
    for line, fields in header:
        match fields:
            case ["format", name, "1.0"] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, text] if (count := natural(text)) is not None:
                elements.append(_Element(name, count, []))
            case ["property", "list", length, kind, name] if (
                elements and {length, kind} <= PLY_TYPES.keys()
            ):
                elements[-1].properties.append(_Property(name, PLY_TYPES[kind], PLY_TYPES[length]))
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1].properties.append(_Property(name, PLY_TYPES[kind]))
            case ["comment" | "obj_info" | "#", *_] | ["ply"] | ["end_header"]:
                pass
            case _:
                fail(f"header line {line} is not valid PLY: '{' '.join(fields)}'", EXPORT)
    if order is None:
        fail("the header states no format", EXPORT)
    return order, elements


def _skip_element(content: bytes, start: int, element: _Element, order: str) -> int:
    """Return the offset after a binary element that precedes the vertices."""
    if not element.has_list:
        return start + element.record(order).itemsize * element.count
    try:
        for _ in range(element.count):
            for prop in element.properties:
                length = 1
                if prop.length_type:
                    head = np.dtype(order + prop.length_type)
                    length = int(np.frombuffer(content, head, 1, start)[0])
                    start += head.itemsize
                start += length * np.dtype(prop.type).itemsize
    except ValueError:  # frombuffer ran past the end
        fail(f"is truncated within element '{element.name}'", EXPORT)
    return start


# --- PCD ------------------------------------------------------------------------------------------------


class Pcd(NamedTuple):
    """Fields of a PCD file, their types, the columns of coordinates, and where the points begin."""

    names: list[str]
    types: list[np.dtype]
    columns: list[int]
    n_points: int
    kind: str
    start: int

    @property
    def first(self) -> list[int]:
        """The first text column of each field, and the number of text columns."""
        return np.cumsum([0, *(dtype.shape[0] for dtype in self.types)]).tolist()


def read_pcd(stream: BinaryIO, _: str | None) -> Points:
    """Read the points of a PCD file (Point Cloud Library): ascii, binary or compressed."""
    content = stream.read()
    pcd = pcd_layout(content)
    if pcd.kind != "ascii":
        return _columns_of(pcd_records(content, pcd), pcd.columns)
    body = text_body(content, pcd.start, 0, pcd.n_points)
    return numbers_of(body, [pcd.first[column] for column in pcd.columns], pcd.first[-1])


def pcd_records(content: bytes, pcd: Pcd) -> np.ndarray:
    """Return the points of a binary file as records, whose fields are called "0", "1", ..."""
    record = np.dtype([(f"{i}", dtype) for i, dtype in enumerate(pcd.types)])
    if pcd.kind == "binary":
        return binary_body(content, pcd.start, record, pcd.n_points)
    return _unpacked(content, pcd.start, record, pcd.n_points)


def pcd_layout(content: bytes) -> Pcd:
    """Read the header of a PCD file."""
    rows, start = _read_header(content, ".pcd", "DATA")
    header = {values[0].upper(): values[1:] for _, values in rows}
    types, n_points = _types(header), _count(header)
    columns = _axis_columns(header["FIELDS"])
    if any(types[column].shape[0] != 1 for column in columns):
        fail("its x, y or z hold several values per point", EXPORT)
    kind = " ".join(header["DATA"])
    if kind not in ("ascii", "binary", "binary_compressed"):
        fail(f"unknown DATA kind '{kind}'", "use ascii, binary or binary_compressed")
    return Pcd(header["FIELDS"], types, columns, n_points, kind, start)


def _types(header: dict[str, list[str]]) -> list[np.dtype]:
    """Return the type of each field: an array of as many numbers as the field holds."""
    codes = {"F": "f", "I": "i", "U": "u"}
    try:
        counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
        columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True)
        return [
            np.dtype((f"<{codes[kind]}{int(size)}", (int(count),)))
            for _, kind, size, count in columns
        ]
    except (KeyError, ValueError, TypeError):
        fail("FIELDS, SIZE, TYPE and COUNT of the header do not fit together", EXPORT)


def _count(header: dict[str, list[str]]) -> int:
    try:
        stated = _natural(header["POINTS"][0]) if "POINTS" in header else None
        if stated is not None and "WIDTH" not in header:
            return stated
        width, height = _natural(header["WIDTH"][0]), _natural(header.get("HEIGHT", ["1"])[0])
    except (KeyError, IndexError, ValueError):
        fail("the header states no valid number of points", EXPORT)
    if stated not in (None, width * height):
        shape = f"WIDTH x HEIGHT = {width} x {height}"
        fail(f"the header states POINTS {stated}, but {shape}", CORRECT)
    return width * height


def _natural(text: str) -> int:
    if (count := natural(text)) is None:
        raise ValueError(text)
    return count


def _unpacked(content: bytes, start: int, record: np.dtype, n_points: int) -> np.ndarray:
    """Return the records of compressed data, which hold one field after the other."""
    types = [record[name] for name in record.names or ()]
    ends = np.cumsum([0] + [dtype.itemsize * n_points for dtype in types]).tolist()
    try:
        packed_size, size = struct.unpack_from("<II", content, start)
        packed = content[start + 8 : start + 8 + packed_size]
        data = lzf_decompress(packed, size) if size else b""
        if (len(packed), len(data), size) != (packed_size, size, ends[-1]):
            raise IndexError
    except (struct.error, IndexError):
        fail("the compressed data are damaged or cut off", EXPORT)
    table = np.empty(n_points, record)
    for i, dtype in enumerate(types):
        table[f"{i}"] = np.frombuffer(data, dtype, n_points, ends[i])
    return table


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


# --- OFF ------------------------------------------------------------------------------------------------


def read_off(stream: BinaryIO, _: str | None) -> Points:
    """Read the vertices of a 3D OFF file."""
    rows = list(rows_of(lines_of(stream.read())))
    if not rows:
        fail("is empty", EXPORT)
    line, fields = rows.pop(0)
    magic, *counts = fields or [""]
    # letters before OFF announce colours, normals or texture, which follow the coordinates
    if not re.fullmatch(r"(ST)?C?N?OFF", magic):
        fail(f"line {line}: '{magic[:40]}' is not the start of a 3D OFF file", EXPORT)
    if not counts and rows:
        line, counts = rows.pop(0)
    n_points, n_faces = (*map(natural, counts), None, None)[:2]
    if n_points is None:
        fail(f"line {line} states no number of vertices", EXPORT)
    check_count(n_points, len(rows), None if n_faces is None else len(rows) - n_faces)
    vertices = rows[:n_points]
    width = max(len(vertices[0][1]), 3) if vertices else 3
    return numbers_of(vertices, [0, 1, 2], width)
