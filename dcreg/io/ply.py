"""PLY files, ascii or binary."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dcreg.io.common import EXPORT, fail
from dcreg.io.headed import axis_columns, binary_body, read_header, text_body
from dcreg.io.text import Row, numbers_of

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
# Byte order of each format, as numpy writes it; the text format has none.
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Property:
    name: str
    type: str
    length_type: str = ""  # set for list properties


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_list(self) -> bool:
        return any(prop.length_type for prop in self.properties)

    def record(self, order: str) -> np.dtype:
        """One binary entry of an element without lists; its fields are called "0", "1", ..."""
        return np.dtype([(f"{i}", order + p.type) for i, p in enumerate(self.properties)])


def read_ply(path: Path, _: str | None) -> np.ndarray:
    """The element ``vertex`` of a PLY file."""
    content = path.read_bytes()
    header, start = read_header(path, content, "end_header", magic="ply")
    order, elements = _parsed(path, header)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        fail(path, "declares no element 'vertex'", "export the file with its points")
    if vertex.has_list:
        fail(path, "its vertices have list properties", "export the points alone")
    columns = axis_columns(path, [prop.name for prop in vertex.properties])
    at = elements.index(vertex)
    before, behind = elements[:at], elements[at + 1 :]
    if not order:
        skip, rest = (sum(e.count for e in part) for part in (before, behind))
        body = text_body(path, content, start, skip, vertex.count, rest)
        return numbers_of(path, body, columns, len(vertex.properties))
    for element in before:
        start = _skip_element(path, content, start, element, order)
    after = (
        None
        if any(element.has_list for element in behind)
        else sum(element.record(order).itemsize * element.count for element in behind)
    )
    return binary_body(path, content, start, vertex.record(order), vertex.count, columns, after)


def _parsed(path: Path, header: list[Row]) -> tuple[str, list[_Element]]:
    """Byte order and elements that the header declares."""
    order: str | None = None
    elements: list[_Element] = []
    for line, fields in header:
        match fields:
            case ["format", name, "1.0"] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if (
                elements and {length, kind} <= _TYPES.keys()
            ):
                prop = _Property(name, _TYPES[kind], _TYPES[length])
                elements[-1].properties.append(prop)
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case ["comment" | "obj_info" | "#", *_] | ["ply"] | ["end_header"]:
                pass
            case _:
                fail(path, f"header line {line} is not valid PLY: '{' '.join(fields)}'", EXPORT)
    if order is None:
        fail(path, "the header states no format", EXPORT)
    return order, elements


def _skip_element(path: Path, content: bytes, start: int, element: _Element, order: str) -> int:
    """Offset behind a binary element that stands before the vertices."""
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
        fail(path, f"is truncated within element '{element.name}'", EXPORT)
    return start
