"""Stable hashes: the same on every machine and in every process."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

_BITS = 30  # of the largest number of an array that count


def digest(value: Any, length: int = 12) -> str:
    """Hash a JSON-like value; keys in any order, floats by their shortest exact text."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def seed(*axes: Any) -> int:
    """Return a 32-bit seed from the axes that it may depend on."""
    return int(digest(list(axes), 8), 16)


def digest_arrays(*arrays: Any, length: int = 12) -> str:
    """Hash arrays: whole numbers exactly, others to about nine digits of the largest one.

    The same computation differs in the last digits on other processors.
    """
    total = hashlib.sha256()
    for array in map(np.ascontiguousarray, arrays):
        is_whole = np.issubdtype(array.dtype, np.integer)
        plain = array.astype(np.int64) if is_whole else _rounded(array)
        total.update(f"{plain.dtype.str}{plain.shape}".encode() + plain.tobytes())
    return total.hexdigest()[:length]


def _rounded(array: np.ndarray) -> np.ndarray:
    """Return multiples of a unit; zero has no sign.

    The unit is a power of two that changes where the largest number is 0.9 times one: many clouds are
    normalised, and their largest number is one half or 1 up to rounding.
    """
    _, exponent = np.frexp(np.abs(array).max(initial=0.0) / 0.9)
    return np.rint(np.ldexp(array.astype(float), _BITS - int(exponent))) + 0.0


def digest_files(root: Path, entries: Iterable[str], length: int = 12) -> str:
    """Hash files and folders below `root` by names and content; missing ones are allowed."""
    total = hashlib.sha256()
    for entry in entries:
        path = root / entry
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.is_file() and "__pycache__" not in file.parts:
                total.update(str(file.relative_to(root)).encode() + b"\0" + file.read_bytes())
    return total.hexdigest()[:length]


def digest_paths(paths: Iterable[Path], root: Path, length: int = 12) -> str:
    """Hash the contents of files, and their paths relative to `root`, or names if they are elsewhere."""
    named = [
        (path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name, path)
        for path in paths
    ]
    total = hashlib.sha256()
    for name, path in sorted(named):
        total.update(name.encode() + b"\0" + path.read_bytes())
    return total.hexdigest()[:length]
