"""MATLAB files up to v7, without the compiled reader of SciPy, which crashes on damaged ones.

Files of v5 to v7 are sequences of elements: kind, size, content. A variable is an element of elements.
Files of v4 are left to SciPy, whose reader of these is Python.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

MATRIX, COMPRESSED = 14, 15
# Types of numbers by the kind of their element.
NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
# Types of arrays by their class; others are texts, cells, structures, objects and sparse matrices.
CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
HEADER = 128  # bytes
IS_COMPLEX = 1 << 11

# Named arrays of a file; None stands for an entry that is not a plain array.
Arrays = dict[str, np.ndarray | None]


def load(stream: BinaryIO) -> Arrays:
    """Return the variables of a MATLAB file.

    Raises
    ------
    ValueError, struct.error, zlib.error, and what SciPy raises for v4
        The file is damaged, or of v7.3 (HDF5).
    """
    content = stream.read()
    if 0 in content[:4]:  # v4: there the text of the header would begin
        from scipy.io import loadmat

        stream.seek(0)
        return {name: value for name, value in loadmat(stream).items() if name[:2] != "__"}
    order = {b"IM": "<", b"MI": ">"}.get(content[HEADER - 2 : HEADER])
    if order is None or content[HEADER - 4 : HEADER - 2] not in (b"\0\1", b"\1\0"):
        raise ValueError("the header is not that of v5 to v7")
    found: Arrays = {}
    for kind, body in _elements(content[HEADER:], order):
        inner = [(kind, body)]
        if kind == COMPRESSED:
            inner = list(_elements(zlib.decompress(body), order))
        found.update(_variable(body, order) for kind, body in inner if kind == MATRIX)
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of each element."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start = at + 8
        if kind >> 16:  # a small one: the size is in the upper half, the content where the size was
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        if start + size > len(data):
            raise ValueError("it is cut off")
        yield kind, data[start : start + size]
        at = start + size
        if kind != COMPRESSED:
            at += -at % 8


def _variable(data: bytes, order: str) -> tuple[str, np.ndarray | None]:
    """Return the name and the array of a variable; None if it is not a plain array."""
    (_, flags), (_, shape), (_, name), *parts = _elements(data, order)
    (flag, _) = struct.unpack(f"{order}II", flags)
    text = name.decode("latin-1")
    if flag & 0xFF not in CLASSES:
        return text, None
    values = [np.frombuffer(body, order + NUMBERS[kind]) for kind, body in parts]
    array = values[0] + 1j * values[1] if flag & IS_COMPLEX else values[0]
    if not flag & IS_COMPLEX:
        array = array.astype(CLASSES[flag & 0xFF])
    return text, array.reshape(np.frombuffer(shape, f"{order}i4"), order="F")
