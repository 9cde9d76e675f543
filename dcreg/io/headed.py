"""What PLY and PCD have in common: a header, then a text or binary body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dcreg.io.common import EXPORT, fail, listing
from dcreg.io.text import Row, lines_of, rows_of


def read_header(path: Path, content: bytes, last: str, magic: str = "") -> tuple[list[Row], int]:
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
    fail(path, f"has no complete {kind} header (no line '{last}')", "it may be cut off; " + EXPORT)


def axis_columns(path: Path, names: list[str]) -> list[int]:
    """Positions of x, y and, where there is one, z."""
    if "x" not in names or "y" not in names:
        fail(path, f"points have no x and y (properties: {listing(names)})", EXPORT)
    return [names.index(axis) for axis in "xyz" if axis in names]


def text_body(
    path: Path, content: bytes, start: int, skip: int, count: int, after: int = 0
) -> list[Row]:
    """`count` text rows behind a header, after `skip` others; `after` more of them end the file."""
    lines = lines_of(path, content[start:])
    rows = list(rows_of(lines, content[:start].count(b"\n") + 1))
    check_complete(path, count, max(0, len(rows) - skip))
    check_end(path, count, max(0, len(rows) - skip - after))
    return rows[skip : skip + count]


def binary_body(
    path: Path,
    content: bytes,
    start: int,
    record: np.dtype,
    count: int,
    columns: list[int],
    after: int | None = 0,
) -> np.ndarray:
    """The given columns of `count` binary records behind a header.

    `after` bytes follow them; None where their number is not known.
    """
    found = max(0, len(content) - start) // record.itemsize
    check_complete(path, count, found)
    if after is not None:
        check_end(path, count, max(0, len(content) - start - after) // record.itemsize)
    table = np.frombuffer(content, record, count, start)
    return np.column_stack([table[f"{column}"].reshape(count) for column in columns])


def check_complete(path: Path, announced: int, found: int) -> None:
    """Refuse a file with fewer points than its header announces."""
    if found < announced:
        fail(
            path,
            f"is truncated: the header announces {announced} points, the file holds {found}",
            "copy or export the file again",
        )


def check_end(path: Path, announced: int, found: int) -> None:
    """Refuse a file with more points than its header announces."""
    if found > announced:
        fail(
            path,
            f"the header announces {announced} points, the file holds {found}",
            "correct the header or " + EXPORT,
        )
