"""Copies of point files in which the points have moved: text, PLY, PCD and arrays.

Only coordinates and normals change. Everything else is copied: other columns, faces, comments.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from dcreg.io.mesh import (
    PLY_TYPES,
    pcd_layout,
    pcd_records,
    ply_layout,
    ply_records,
    ply_rows,
    text_body,
)
from dcreg.io.move import Change, Changes, Move, new_type
from dcreg.io.text import Row, text_table, with_fields

_PLY_NAMES = {"f4": "float", "f8": "double"}
_LINE = re.compile(rb"[^\n]*\n")  # of a header, as the readers divide it


# --- edited copies of text ----------------------------------------------------------------------------


def _text(content: bytes, move: Move, *, any_width: bool = False) -> bytes:
    table = text_table(content, any_width=any_width)
    changes = move.changes(table.names, table.columns, _column_of(table.rows))
    return _with_rows(content, 0, table.rows, changes)


def _column_of(rows: list[Row]) -> Callable[[int], np.ndarray]:
    """Return a function from a column to its numbers; what is not a number becomes NaN."""
    return lambda column: np.array([_number(fields, column) for _, fields in rows])


def _number(fields: list[str], column: int) -> float:
    try:
        return float(fields[column])
    except (ValueError, IndexError):
        return np.nan


def _with_rows(content: bytes, start: int, rows: list[Row], changes: Changes) -> bytes:
    """Return text with the new values in its rows; the text before `start` is left out."""
    first = content[:start].count(b"\n") + 1
    text = content[start:].decode("utf-8", "surrogateescape").removeprefix("\ufeff")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for at, (number, _) in enumerate(rows):
        fields = {
            column: repr(float(change.values[at]))
            for column, change in changes.items()
            if change.rows[at]
        }
        lines[number - first] = with_fields(lines[number - first], fields)
    return "\n".join(lines).encode("utf-8", "surrogateescape")


# --- edited copies of PLY and PCD ---------------------------------------------------------------------


def _with_records(table: np.ndarray, changes: Changes) -> np.ndarray:
    """Return records with the new values, in a type that holds them."""
    kinds = []
    for column, name in enumerate(table.dtype.names or ()):
        kind = table.dtype[name]
        if column in changes:
            kind = np.dtype((new_type(kind.base, changes[column]), kind.shape))
        kinds.append((name, kind))
    edited = np.empty(len(table), kinds)
    with np.errstate(all="ignore"):
        for name, _ in kinds:
            edited[name] = table[name]
        for column, change in changes.items():
            values = edited[f"{column}"].reshape(len(table))
            values[change.rows] = change.values[change.rows]
    return edited


def _ply(content: bytes, move: Move) -> bytes:
    ply = ply_layout(content)
    properties = ply.vertex.properties
    names = [each.name for each in properties]
    if not ply.order:
        rows = ply_rows(content, ply)
        changes = move.changes(names, ply.columns, _column_of(rows))
        body = _with_rows(content, ply.start, rows, changes)
        types = {
            names[at]: new_type(np.dtype(properties[at].type), change)
            for at, change in changes.items()
        }
        return _ply_header(content[: ply.start], types) + body
    old = ply_records(content, ply)
    changes = move.changes(names, ply.columns, lambda column: old[f"{column}"].astype(np.float64))
    new = _with_records(old, changes)
    types = {names[at]: new.dtype[f"{at}"] for at in changes}
    before, after = content[ply.header : ply.start], content[ply.start + old.nbytes :]
    return _ply_header(content[: ply.header], types) + before + new.tobytes() + after


def _ply_header(header: bytes, types: Mapping[str, np.dtype]) -> bytes:
    """Return a header with the types of some vertex properties; unchanged lines are copied."""
    lines, is_vertex = [], False
    for line in _LINE.findall(header):
        match line.decode("utf-8", errors="replace").split():
            case ["element", name, _]:
                is_vertex = name == "vertex"
            case ["property", kind, name] if is_vertex and name in types:
                code = f"{types[name].kind}{types[name].itemsize}"
                if PLY_TYPES[kind] != code:
                    line = re.sub(
                        rb"\b" + kind.encode() + rb"\b", _PLY_NAMES[code].encode(), line, count=1
                    )
        lines.append(line)
    return b"".join(lines)


def _pcd(content: bytes, move: Move) -> bytes:
    pcd = pcd_layout(content)
    if pcd.kind == "ascii":
        rows, first = text_body(content, pcd.start, 0, pcd.n_points), pcd.first
        column_of = _column_of(rows)
        changes = move.changes(pcd.names, pcd.columns, lambda column: column_of(first[column]))
        types = [
            new_type(kind.base, changes[at]) if at in changes else kind.base
            for at, kind in enumerate(pcd.types)
        ]
        placed = {first[at]: change for at, change in changes.items()}
        body = _with_rows(content, pcd.start, rows, placed)
    else:
        old = pcd_records(content, pcd)
        changes = move.changes(
            pcd.names,
            pcd.columns,
            lambda column: old[f"{column}"].reshape(len(old)).astype(np.float64),
        )
        new = _with_records(old, changes)
        types = [new.dtype[name].base for name in new.dtype.names or ()]
        body = new.tobytes()
    return _pcd_header(content[: pcd.start], types) + body


def _pcd_header(header: bytes, types: list[np.dtype]) -> bytes:
    """Return a header with the types of its fields, for points that are not compressed."""
    codes = {"f": "F", "i": "I", "u": "U"}
    sizes = [str(kind.itemsize) for kind in types]
    lines = []
    for line in _LINE.findall(header):
        fields = line.decode("utf-8", errors="replace").split()
        match fields:
            case [name, *_] if name.upper() == "SIZE":
                new = [name, *sizes]
            case [name, *_] if name.upper() == "TYPE":
                new = [name, *(codes[kind.kind] for kind in types)]
            case [name, "binary_compressed"] if name.upper() == "DATA":
                new = [name, "binary"]
            case _:
                new = fields
        lines.append(line if new == fields else f"{' '.join(new)}\n".encode())
    return b"".join(lines)


# --- edited copies of arrays --------------------------------------------------------------------------


def array_file(old: np.dtype, move: Move) -> bytes:
    """Return the moved points as the content of an ``.npy`` file, in a type that holds them."""
    stream = io.BytesIO()
    with np.errstate(all="ignore"):
        np.save(
            stream, move.moved.astype(new_type(old, Change(move.moved, move.valid, move.is_wide)))
        )
    return stream.getvalue()


def _npy(content: bytes, move: Move) -> bytes:
    return array_file(np.load(io.BytesIO(content), allow_pickle=False).dtype, move)


def edit_npz(content: bytes, name: str, old: np.dtype, move: Move) -> bytes:
    """Return an archive with one array replaced; all others are copied."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(out, "w") as copy:
        for entry in archive.infolist():
            is_cloud = entry.filename in (name, f"{name}.npy")
            copy.writestr(entry, array_file(old, move) if is_cloud else archive.read(entry))
    return out.getvalue()


# --- the table of formats -----------------------------------------------------------------------------

# Functions that edit a copy of a file of the same format. Archives need the name of their array, too.
EDITORS: dict[str, Callable[[bytes, Move], bytes]] = {
    ".ply": _ply,
    ".pcd": _pcd,
    ".npy": _npy,
    ".txt": _text,
    ".csv": _text,
    ".xyz": partial(_text, any_width=True),
}
