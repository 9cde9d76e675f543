"""Files that are written whole or not at all, and results as JSON."""

from __future__ import annotations

import json
import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import orjson

_JSON = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A neighbour of `path` to write to; it takes the place of `path` when the block ends well.

    Whatever goes wrong (a full disk, an interrupt, an error of the writer), an old file stays as it was
    and no half-written one is left.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     place = pathlib.Path(folder) / "note.txt"
    ...     with whole_file(place) as part:
    ...         _ = part.write_text("done")
    ...     place.read_text()
    'done'
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def as_json(content: Any, *, indented: bool = True) -> str:
    """`content` as JSON, arrays as lists; a number that is not finite (an unknown bound) is null."""
    layout = orjson.OPT_INDENT_2 if indented else 0
    try:
        return orjson.dumps(content, option=_JSON | layout).decode()
    except orjson.JSONEncodeError:
        # a file name that is no text, an array that is not contiguous, a number beyond 64 bits
        return json.dumps(plain(content), indent=2 if indented else None, allow_nan=False)


def plain(value: Any) -> Any:
    """`value` made of what JSON knows; a number that is not finite becomes None."""
    match value:
        case dict():
            return {str(key): plain(item) for key, item in value.items()}
        case list() | tuple():
            return [plain(item) for item in value]
        case float() if not math.isfinite(value):
            return None
        case _ if hasattr(value, "tolist"):  # arrays and numbers of NumPy
            return plain(value.tolist())
        case _:
            return value
