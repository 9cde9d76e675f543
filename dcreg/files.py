"""Files that are written completely or not at all, and results as JSON."""

from __future__ import annotations

import abc
import json
import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from dcreg._version import __version__


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary neighbour of `path` that replaces `path` when the block succeeds.

    If the block fails (a full disk, an interrupt, an error of the writer), an old file stays as it was
    and no partial file remains.

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
    """Write a text file completely or not at all."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def as_json(content: Any, *, indent: int | None = 2) -> str:
    """Return `content` as JSON, after `plain`."""
    return json.dumps(plain(content), indent=indent, allow_nan=False)


def plain(value: Any, digits: int | None = None) -> Any:
    """Return `value` in JSON's types: lists, dictionaries, and None for a number that is not finite.

    With `digits`, numbers are rounded to so many significant ones.
    """
    match value:
        case dict():
            return {str(key): plain(item, digits) for key, item in value.items()}
        case tuple() if hasattr(value, "_asdict"):
            return plain(value._asdict(), digits)
        case list() | tuple():
            return [plain(item, digits) for item in value]
        case float() if not math.isfinite(value):
            return None
        case _ if hasattr(value, "tolist"):  # arrays and numbers of NumPy
            is_plain = value.dtype.kind in "iub"  # long lists of pairs, for instance
            return value.tolist() if is_plain else plain(value.tolist(), digits)
        case float() if digits is not None:
            return float(f"{value:.{digits}g}")
        case _ if is_dataclass(value):
            return {
                entry.name: plain(getattr(value, entry.name), digits) for entry in fields(value)
            }
        case _:
            return value


class Document(abc.ABC):
    """What can be written as JSON."""

    @abc.abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""

    def to_json(self, **more: Any) -> str:
        """Return `to_dict`, the version and `more` keys (such as file names) as JSON."""
        return as_json({**self.to_dict(), **more, "dcreg_version": __version__})

    def write_json(self, path: str | Path, **more: Any) -> None:
        """Write `to_json` to a file."""
        write_text(path, self.to_json(**more) + "\n")
