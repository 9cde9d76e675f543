"""Reading point clouds from the usual file formats, with errors that say how to mend the file.

Every reader is small and needs nothing but NumPy (and SciPy for ``.mat``), so that the library can
open clouds on a machine without open3d. Pickled data is never loaded.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np

from dcreg.problem import InputError

_DIMENSIONS = (2, 3)
_EXPORT = "export the file again"  # the remedy for damage that no text editor mends
_KEYED_SUFFIXES = (".npz", ".mat")

# One text row: its line number in the file (from 1) and its fields.
Row = tuple[int, list[str]]

# Named arrays of an archive; None stands for what is no plain array (or was not asked for).
Arrays = dict[str, np.ndarray | None]


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
        _fail(path, "is a folder", "give the path of a point file")
    if suffix not in _READERS:
        _fail(path, f"unknown extension '{path.suffix}'", f"use one of: {' '.join(_READERS)}")
    if key is not None and suffix not in _KEYED_SUFFIXES:
        _fail(path, f"key '{key}' given, but {suffix} files hold no named arrays", "drop the key")
    try:
        points = _READERS[suffix](path, key)
    except FileNotFoundError:
        _fail(path, "no such file", f"check the path (working folder: {Path.cwd()})")
    except OSError as error:
        _fail(path, f"cannot be read: {error.strerror or error}", "check permissions and the disk")
    return _checked(path, points)


def _fail(path: Path, problem: str, remedy: str) -> NoReturn:
    raise InputError(f"{path}: {problem}; {remedy}")


def _split_key(path: str | Path, key: str | None) -> tuple[Path, str | None]:
    """Take ``file.npz:key`` apart; an explicit `key` and a file of that very name win."""
    text = str(path)
    stem, _, name = text.rpartition(":")
    if key is None and Path(stem).suffix.lower() in _READERS and not Path(text).exists():
        return Path(stem), name
    return Path(text), key


def _checked(path: Path, points: np.ndarray) -> np.ndarray:
    """What must hold for every format, whatever its reader has checked."""
    if points.ndim != 2 or points.shape[1] not in _DIMENSIONS:
        remedy = "points go in rows, with 2 or 3 columns"
        if points.ndim == 2 and points.shape[0] in _DIMENSIONS:
            remedy += " (this array looks transposed)"
        _fail(path, f"wrong dimension: the array has shape {points.shape}", remedy)
    if len(points) == 0:
        _fail(path, "holds no points", "give a file with at least one point")
    points = np.ascontiguousarray(points, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        _fail(
            path,
            f"NaN or infinity in {bad.size} of {len(points)} points, "
            f"first in point {bad[0]} (from 0): {points[bad[0]].tolist()}",
            "remove these points",
        )
    return points


# --- text -----------------------------------------------------------------------------------------


def _read_text(path: Path, _: str | None) -> np.ndarray:
    return _table(path, any_width=False)


def _read_xyz(path: Path, _: str | None) -> np.ndarray:
    # Columns after the third are normals, colours or intensities by the habit of the format.
    return _table(path, any_width=True)


def _table(path: Path, *, any_width: bool) -> np.ndarray:
    """Rows of numbers, optionally after a line with the number of points and a header row."""
    rows = list(_rows(_lines(path, path.read_bytes())))
    if not rows:
        _fail(path, "is empty", "give one point per line")
    announced = None
    if len(rows[0][1]) == 1 and rows[0][1][0].isdigit():
        announced = int(rows.pop(0)[1][0])
    names = rows.pop(0)[1] if rows and not any(map(_is_number, rows[0][1])) else None
    if announced is not None and announced != len(rows):
        _fail(
            path,
            f"the first line announces {announced} points, {len(rows)} follow",
            "the file may be cut off; mend it or correct that line",
        )
    if not rows:
        _fail(path, "holds no points", "give one point per line")
    width = len(rows[0][1] if names is None else names)
    return _numbers(path, rows, _columns(path, names, width, any_width), width)


def _columns(path: Path, names: list[str] | None, width: int, any_width: bool) -> list[int]:
    """Which columns are coordinates: those the header names x, y(, z), else all of 2 or 3."""
    lowered = [name.strip("\"' ").lower() for name in names or []]
    if "x" in lowered and "y" in lowered:
        return [lowered.index(axis) for axis in "xyz" if axis in lowered]
    if width not in _DIMENSIONS and not (any_width and width > 3):
        _fail(
            path,
            f"wrong dimension: {width} column{'s' * (width != 1)}",
            "keep 2 or 3 columns, or add a header row that names x, y (and z)",
        )
    return list(range(min(width, 3)))


def _lines(path: Path, content: bytes) -> list[str]:
    if b"\0" in content[:4096]:
        _fail(path, "is not plain text (zero bytes found)", "save it as UTF-8 text")
    text = content.decode("utf-8-sig", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _rows(lines: Iterable[str], first_line: int = 1) -> Iterable[Row]:
    """Split lines into fields; blank lines and comments (``#``, ``%``, ``//``) go."""
    for number, line in enumerate(lines, first_line):
        content = re.split(r"#|%|//", line, maxsplit=1)[0].strip()
        if content:
            yield number, _fields(content)


def _fields(content: str) -> list[str]:
    """Fields of one line. An empty field between separators stays, so that it is noticed."""
    if not re.search("[,;]", content):
        return content.split()
    fields = [field.strip() for field in re.split("[,;]", content)]
    return fields[:-1] if fields[-1] == "" else fields


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _numbers(path: Path, rows: Sequence[Row], columns: Sequence[int], width: int) -> np.ndarray:
    """The given columns of text rows as floats; errors name the line."""
    points = np.empty((len(rows), len(columns)))
    for i, (line, fields) in enumerate(rows):
        if len(fields) != width:
            _fail(
                path,
                f"line {line} has {len(fields)} value{'s' * (len(fields) != 1)}, expected {width}",
                "give every point the same number of values",
            )
        try:
            points[i] = [float(fields[column]) for column in columns]
        except ValueError:
            bad = next(fields[c] for c in columns if not _is_number(fields[c]))
            _fail(path, f"line {line}: '{bad[:40]}' is not a number", "correct or remove that line")
        if not np.isfinite(points[i]).all():
            _fail(path, f"line {line} holds NaN or infinity", "remove that point")
    return points


# --- arrays ---------------------------------------------------------------------------------------


def _read_npy(path: Path, _: str | None) -> np.ndarray:
    array = _loaded(path, partial(np.load, allow_pickle=False))
    if not isinstance(array, np.ndarray):
        _fail(path, "holds several arrays", "rename it to .npz")
    return _real(path, array)


def _read_npz(path: Path, key: str | None) -> np.ndarray:
    arrays = _loaded(path, partial(_npz_arrays, key=key))
    if arrays is None:
        _fail(path, "holds a single array", "rename it to .npy")
    return _pick(path, arrays, key)


def _npz_arrays(stream: BinaryIO, key: str | None) -> Arrays | None:
    """All names, but only the array `key` if one is given: archives can be large."""
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


def _read_mat(path: Path, key: str | None) -> np.ndarray:
    from scipy.io import loadmat

    content = _loaded(path, loadmat)
    arrays: Arrays = {
        name: value if isinstance(value, np.ndarray) else None
        for name, value in content.items()
        if not name.startswith("__")
    }
    return _pick(path, arrays, key)


def _loaded(path: Path, load: Callable[[BinaryIO], Any]) -> Any:
    """What a foreign reader makes of a file; on damage these raise almost anything."""
    with path.open("rb") as stream:
        try:
            return load(stream)
        except Exception as error:
            # MATLAB's default for large data, v7.3, is HDF5, which SciPy does not read
            remedy = "save it again" + " with: save -v7" * (path.suffix.lower() == ".mat")
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            _fail(path, f"is not a readable {path.suffix} file ({reason})", remedy)


def _pick(path: Path, arrays: Arrays, key: str | None) -> np.ndarray:
    """The array called `key`, or the only one that can be a point cloud."""
    listing = _listing(list(arrays))
    if key is not None:
        if key not in arrays:
            _fail(path, f"has no array '{key}'", f"choose one of: {listing}")
        return _real(path, arrays[key], key)
    clouds = {name: array for name, array in arrays.items() if _is_cloud(array)}
    if not clouds:
        _fail(path, "holds no numeric array with 2 or 3 columns", f"arrays found: {listing}")
    if len(clouds) > 1:
        first = next(iter(clouds))
        _fail(
            path,
            f"is ambiguous, several arrays can be point clouds: {_listing(list(clouds))}",
            f"name one, for example '{path.name}:{first}' or --source-key / --target-key {first}",
        )
    return _real(path, next(iter(clouds.values())))


def _listing(names: Sequence[str], most: int = 12) -> str:
    rest = f", ... ({len(names)} in all)" if len(names) > most else ""
    return ", ".join(names[:most]) + rest if names else "none"


def _is_cloud(array: np.ndarray | None) -> bool:
    return (
        array is not None
        and array.dtype.kind in "fiu"
        and array.ndim == 2
        and array.shape[1] in _DIMENSIONS
    )


def _real(path: Path, array: np.ndarray | None, key: str | None = None) -> np.ndarray:
    what = "the array" if key is None else f"array '{key}'"
    if array is None:
        _fail(path, f"{what} holds objects, which are not loaded", "store plain numbers")
    if array.dtype.kind not in "fiu":
        _fail(path, f"{what} has type {array.dtype}", "store real numbers")
    return array


# --- ply ------------------------------------------------------------------------------------------

_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


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
        return np.dtype([(f"{i}", order + p.type) for i, p in enumerate(self.properties)])


def _read_ply(path: Path, _: str | None) -> np.ndarray:
    content = path.read_bytes()
    header, start = _header(path, content, "end_header", magic="ply")
    order, elements = _ply_header(path, header)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        _fail(path, "declares no element 'vertex'", "export the file with its points")
    if vertex.has_list:
        _fail(path, "its vertices have list properties", "export the points alone")
    columns = _axes(path, [prop.name for prop in vertex.properties])
    before = elements[: elements.index(vertex)]
    if not order:
        body = _body(path, content, start, sum(e.count for e in before), vertex.count)
        return _numbers(path, body, columns, len(vertex.properties))
    for element in before:
        start = _skip_element(path, content, start, element, order)
    return _records(path, content, start, vertex.record(order), vertex.count, columns)


def _ply_header(path: Path, header: list[Row]) -> tuple[str, list[_Element]]:
    order: str | None = None
    elements: list[_Element] = []
    for line, fields in header:
        match fields:
            case ["format", name, "1.0"] if name in _PLY_ORDERS:
                order = _PLY_ORDERS[name]
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if (
                elements and {length, kind} <= _PLY_TYPES.keys()
            ):
                prop = _Property(name, _PLY_TYPES[kind], _PLY_TYPES[length])
                elements[-1].properties.append(prop)
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                elements[-1].properties.append(_Property(name, _PLY_TYPES[kind]))
            case ["comment" | "obj_info" | "#", *_] | ["ply"] | ["end_header"]:
                pass
            case _:
                _fail(path, f"header line {line} is not valid PLY: '{' '.join(fields)}'", _EXPORT)
    if order is None:
        _fail(path, "the header states no format", _EXPORT)
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
        _fail(path, f"is truncated within element '{element.name}'", _EXPORT)
    return start


# --- pcd ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Field:
    name: str
    dtype: np.dtype  # an array of `count` numbers

    @property
    def count(self) -> int:
        return self.dtype.shape[0]


def _read_pcd(path: Path, _: str | None) -> np.ndarray:
    content = path.read_bytes()
    rows, start = _header(path, content, "DATA")
    header = {values[0].upper(): values[1:] for _, values in rows}
    fields, n_points = _pcd_fields(path, header), _pcd_count(path, header)
    columns = _axes(path, [field.name for field in fields])
    if any(fields[column].count != 1 for column in columns):
        _fail(path, "its x, y or z hold several values per point", _EXPORT)
    match header["DATA"]:
        case ["ascii"]:
            body = _body(path, content, start, 0, n_points)
            # A field with a count above one fills several text columns.
            first = np.cumsum([0] + [field.count for field in fields]).tolist()
            return _numbers(path, body, [first[column] for column in columns], first[-1])
        case ["binary"]:
            record = np.dtype([(f"{i}", field.dtype) for i, field in enumerate(fields)])
            points = _records(path, content, start, record, n_points, columns)
        case ["binary_compressed"]:
            points = _pcd_compressed(path, content, start, fields, n_points, columns)
        case other:
            remedy = "use ascii, binary or binary_compressed"
            _fail(path, f"unknown DATA kind '{' '.join(other)}'", remedy)
    return points


def _pcd_fields(path: Path, header: dict[str, list[str]]) -> list[_Field]:
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
        _fail(path, "FIELDS, SIZE, TYPE and COUNT of the header do not fit together", _EXPORT)


def _pcd_count(path: Path, header: dict[str, list[str]]) -> int:
    try:
        if "POINTS" in header:
            return _natural(header["POINTS"][0])
        return _natural(header["WIDTH"][0]) * _natural(header["HEIGHT"][0])
    except (KeyError, IndexError, ValueError):
        _fail(path, "the header states no valid number of points", _EXPORT)


def _natural(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(text)
    return int(text)


def _pcd_compressed(
    path: Path, content: bytes, start: int, fields: list[_Field], n_points: int, columns: list[int]
) -> np.ndarray:
    """LZF-packed data; unpacked, it holds one field after the other, each for all points."""
    ends = np.cumsum([0] + [field.dtype.itemsize * n_points for field in fields]).tolist()
    try:
        packed_size, size = struct.unpack_from("<II", content, start)
        packed = content[start + 8 : start + 8 + packed_size]
        data = _lzf_decompress(packed, size) if size else b""
    except (struct.error, IndexError):
        _fail(path, "the compressed data are damaged or cut off", _EXPORT)
    if len(packed) != packed_size or len(data) != size or size != ends[-1]:
        _fail(path, "the compressed data are damaged or cut off", _EXPORT)
    axes = [np.frombuffer(data, fields[c].dtype.base, n_points, ends[c]) for c in columns]
    return np.column_stack(axes)


def _lzf_decompress(packed: bytes, size: int) -> bytes:
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


# --- off ------------------------------------------------------------------------------------------


def _read_off(path: Path, _: str | None) -> np.ndarray:
    rows = list(_rows(_lines(path, path.read_bytes())))
    if not rows:
        _fail(path, "is empty", _EXPORT)
    line, (magic, *counts) = rows.pop(0)
    # Letters before OFF announce colours, normals or texture, which follow the coordinates.
    if not re.fullmatch(r"(ST)?C?N?OFF", magic):
        _fail(path, f"line {line}: '{magic[:40]}' is not the start of a 3D OFF file", _EXPORT)
    if not counts and rows:
        line, counts = rows.pop(0)
    if not counts or not counts[0].isdecimal():
        _fail(path, f"line {line} states no number of vertices", _EXPORT)
    n_points = int(counts[0])
    _complete(path, n_points, len(rows))
    vertices = rows[:n_points]
    width = max((len(vertices[0][1]), 3)) if vertices else 3
    return _numbers(path, vertices, [0, 1, 2], width)


# --- shared by the formats with a header ----------------------------------------------------------


def _header(path: Path, content: bytes, last: str, magic: str = "") -> tuple[list[Row], int]:
    """Lines up to the one that starts with `last`, and the offset of what follows it."""
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
    kind = path.suffix.lower()
    _fail(
        path, f"has no complete {kind} header (no line '{last}')", "it may be cut off; " + _EXPORT
    )


def _axes(path: Path, names: list[str]) -> list[int]:
    """Positions of x, y and, where there is one, z."""
    if "x" not in names or "y" not in names:
        _fail(path, f"points have no x and y (properties: {_listing(names)})", _EXPORT)
    return [names.index(axis) for axis in "xyz" if axis in names]


def _body(path: Path, content: bytes, start: int, skip: int, count: int) -> list[Row]:
    """`count` text rows behind a header, after skipping `skip` of them."""
    lines = _lines(path, content[start:])
    rows = list(_rows(lines, content[:start].count(b"\n") + 1))[skip : skip + count]
    _complete(path, count, len(rows))
    return rows


def _records(
    path: Path, content: bytes, start: int, record: np.dtype, count: int, columns: list[int]
) -> np.ndarray:
    _complete(path, count, max(0, len(content) - start) // record.itemsize)
    table = np.frombuffer(content, record, count, start)
    return np.column_stack([table[f"{column}"].reshape(count) for column in columns])


def _complete(path: Path, announced: int, found: int) -> None:
    if found < announced:
        _fail(
            path,
            f"is truncated: the header announces {announced} points, the file holds {found}",
            "copy or export the file again",
        )


# Every reader takes the path and the name of an array (None where a format has no names).
_READERS: dict[str, Callable[[Path, str | None], np.ndarray]] = {
    ".txt": _read_text,
    ".csv": _read_text,
    ".xyz": _read_xyz,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".mat": _read_mat,
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".off": _read_off,
}
