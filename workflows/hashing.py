"""Stable hashes: the same on every machine and in every process."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np


def digest(value: Any, length: int = 12) -> str:
    """Hash a JSON-like value; keys in any order, floats by their shortest exact text."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def seed(*axes: Any) -> int:
    """Return a 32-bit seed from the axes that it may depend on."""
    return int(digest(list(axes), 8), 16)


def digest_arrays(*arrays: Any, length: int = 12) -> str:
    """Hash the exact content of arrays or numbers."""
    total = hashlib.sha256()
    for array in map(np.ascontiguousarray, arrays):
        total.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
    return total.hexdigest()[:length]


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
