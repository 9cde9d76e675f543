"""Text tables of points (`.txt`, `.csv`, `.xyz`), and what all readers share."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple, NoReturn

import numpy as np

from dcreg.problem import InputError

DIMENSIONS = (2, 3)
EXPORT = "export the file again"  # the remedy for damage that cannot be edited

# One text row: its line number in the file (from 1) and its fields.
Row = tuple[int, list[str]]
_DECIMAL_COMMA = re.compile(r"^([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)$")
_COMMENT = re.compile(r"#|%|//")


class Points(NamedTuple):
    """Numbers as a reader finds them, not yet checked, and the line of each row of a text file."""

    array: np.ndarray
    lines: list[int] | None = None


class TextTable(NamedTuple):
    """Rows of a text file, the lower-case names of its header, and the columns of coordinates."""

    rows: list[Row]
    names: list[str]
    columns: list[int]
    width: int


def fail(problem: str, remedy: str) -> NoReturn:
    """Refuse a file; the message has to begin with its name, see `naming`."""
    raise InputError(f"{problem}; {remedy}")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let the messages of `fail` begin with the name of the file."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def listing(names: Sequence[str], maximum: int = 12) -> str:
    """Return names for a message, at most `maximum` of them."""
    rest = f", ... ({len(names)} in all)" if len(names) > maximum else ""
    return ", ".join(names[:maximum]) + rest if names else "none"


def read_text(stream: BinaryIO, _: str | None, *, any_width: bool = False) -> Points:
    """Read rows of 2 or 3 numbers, or the columns that a header row calls x, y and z.

    A line with the number of points may precede them. With `any_width` rows may be longer: the columns
    after the third (normals, colours, intensities) are ignored.
    """
    table = text_table(stream.read(), any_width=any_width)
    return numbers_of(table.rows, table.columns, table.width)


def read_column(stream: BinaryIO, _: str | None) -> Points:
    """Read one number per line."""
    rows = list(rows_of(lines_of(stream.read())))
    return Points(numbers_of(rows, [0], 1).array[:, 0])


def text_table(content: bytes, *, any_width: bool) -> TextTable:
    """Return the rows of a text file and find its coordinates, see `read_text`."""
    rows = list(rows_of(lines_of(content)))
    if not rows:
        fail("is empty", "give one point or pair per line")
    announced = None
    if len(rows[0][1]) == 1 and (announced := natural(rows[0][1][0])) is not None:
        rows.pop(0)
    has_header = rows and all(_number(field) is None for field in rows[0][1])
    names = rows.pop(0)[1] if has_header else None
    if announced is not None and announced != len(rows):
        fail(
            f"the first line announces {announced} points, {len(rows)} follow",
            "the file may be cut off; export it again or correct that line",
        )
    if not rows:
        fail("holds no points", "give one point or pair per line")
    width = len(rows[0][1] if names is None else names)
    lowered = [name.strip("\"' ").lower() for name in names or []]
    return TextTable(rows, lowered, _columns(lowered, width, any_width), width)


def _columns(lowered: list[str], width: int, any_width: bool) -> list[int]:
    """Return the columns of coordinates: those called x, y and z in the header, else all 2 or 3."""
    if "x" in lowered and "y" in lowered:
        return [lowered.index(axis) for axis in "xyz" if axis in lowered]
    if width not in DIMENSIONS and not (any_width and width > 3):
        fail(
            f"wrong dimension: {width} column{'s' * (width != 1)}",
            "keep 2 or 3 columns, or add a header row with x, y (and z); decimals need a point",
        )
    return list(range(min(width, 3)))


def lines_of(content: bytes) -> list[str]:
    """Return the lines of a text file of any system, without line ends."""
    if b"\0" in content[:4096]:
        fail("is not plain text (zero bytes found)", "save it as UTF-8 text")
    text = content.decode("utf-8-sig", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def rows_of(lines: Iterable[str], first_line: int = 1) -> Iterator[Row]:
    """Yield the fields of each line, except blank lines and comments (``#``, ``%``, ``//``)."""
    for number, line in enumerate(lines, first_line):
        content = _COMMENT.split(line, maxsplit=1)[0].strip()
        if content:
            try:
                yield number, _fields(content)
            except csv.Error as error:
                fail(f"line {number} cannot be split into values ({error})", "correct or remove it")


def _fields(content: str) -> list[str]:
    """Return the fields of one line.

    An empty field between separators stays, and `numbers_of` refuses it. If ``;`` separates the fields,
    a comma within a number is a decimal comma.
    """
    content = content.rstrip(";").rstrip()
    separator = _separator(content)
    if separator is None:
        return [field.strip('"') for field in content.split()]
    fields = [field.strip() for field in next(csv.reader([content], delimiter=separator))]
    if separator == ";":
        fields = [_DECIMAL_COMMA.sub(r"\1.\2", field) for field in fields]
    return fields[:-1] if fields[-1] == "" else fields


def _separator(content: str) -> str | None:
    """Return what separates the fields of a line; None: blanks."""
    return ";" if ";" in content else "," if "," in content else None


def with_fields(line: str, changes: Mapping[int, str]) -> str:
    """Return a line with some fields replaced; blanks, comments and all other fields are kept."""
    content = _COMMENT.split(line, maxsplit=1)[0]
    core = content.strip().rstrip(";").rstrip()
    lead, tail = line[: line.find(core)], line[line.find(core) + len(core) :]
    separator = _separator(core)
    if separator is None:
        parts = re.split(r"(\s+)", core)
        for column, text in changes.items():
            parts[2 * column] = text
        return f"{lead}{''.join(parts)}{tail}"
    is_quoted = '"' in core
    fields = next(csv.reader([core], delimiter=separator)) if is_quoted else core.split(separator)
    has_comma = separator == ";" and any(_DECIMAL_COMMA.match(field.strip()) for field in fields)
    for column, text in changes.items():
        fields[column] = text.replace(".", ",") if has_comma else text
    if not is_quoted:
        return f"{lead}{separator.join(fields)}{tail}"
    stream = io.StringIO()
    csv.writer(stream, delimiter=separator, lineterminator="").writerow(fields)
    return f"{lead}{stream.getvalue()}{tail}"


def natural(field: str) -> int | None:
    """Return a count; None if the field is not one, or exceeds that of any file."""
    return int(field) if field.isascii() and field.isdigit() and len(field) < 20 else None


def _number(field: str) -> float | None:
    """Return a number; None if the field is not one, as with the underscores that float() accepts."""
    try:
        return None if "_" in field else float(field)
    except ValueError:
        return None


def _looks_decimal(field: str) -> bool:
    """Whether a field results from a decimal comma between blanks, as ``5 2`` does from ``1,5 2,5``."""
    return "," in field or bool(re.fullmatch(r"-?\d+\s+-?\d+", field))


def numbers_of(rows: Sequence[Row], columns: Sequence[int], width: int) -> Points:
    """Return the given columns of text rows as floats; errors name the line."""
    points = np.empty((len(rows), len(columns)))
    for i, (line, fields) in enumerate(rows):
        if len(fields) != width:
            fail(
                f"line {line} has {len(fields)} value{'s' * (len(fields) != 1)}, expected {width}",
                "give every point the same number of values",
            )
        numbers = [_number(fields[column]) for column in columns]
        if None in numbers:
            bad = fields[columns[numbers.index(None)]]
            remedy = "correct or remove that line"
            if _looks_decimal(bad):
                remedy = "if it has a decimal comma, write a point instead"
            fail(f"line {line}: '{bad[:40]}' is not a number", remedy)
        points[i] = numbers
    return Points(points, [line for line, _ in rows])
