"""OFF files: the vertices of a mesh."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dcreg.io.common import EXPORT, fail
from dcreg.io.headed import check_complete, check_end
from dcreg.io.text import lines_of, numbers_of, rows_of


def read_off(path: Path, _: str | None) -> np.ndarray:
    """The vertices of a 3D OFF file, whatever else it holds."""
    rows = list(rows_of(lines_of(path, path.read_bytes())))
    if not rows:
        fail(path, "is empty", EXPORT)
    line, (magic, *counts) = rows.pop(0)
    # Letters before OFF announce colours, normals or texture, which follow the coordinates.
    if not re.fullmatch(r"(ST)?C?N?OFF", magic):
        fail(path, f"line {line}: '{magic[:40]}' is not the start of a 3D OFF file", EXPORT)
    if not counts and rows:
        line, counts = rows.pop(0)
    if not counts or not counts[0].isdecimal():
        fail(path, f"line {line} states no number of vertices", EXPORT)
    n_points = int(counts[0])
    check_complete(path, n_points, len(rows))
    if len(counts) > 1 and counts[1].isdecimal():
        check_end(path, n_points, len(rows) - int(counts[1]))
    vertices = rows[:n_points]
    width = max((len(vertices[0][1]), 3)) if vertices else 3
    return numbers_of(path, vertices, [0, 1, 2], width)
