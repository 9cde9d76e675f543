"""What sections add to while a page is built: figures, downloads and packed data."""

from __future__ import annotations

import base64
import gzip
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reports.tables import Tables
from reports.theme import Style


@dataclass(frozen=True)
class Figure:
    """An interactive figure: data for one of the builders in ``assets/report.js``."""

    id: str
    title: str
    builder: str
    payload: dict[str, Any]


@dataclass(frozen=True)
class Download:
    """A file that can be saved from the page."""

    name: str
    description: str
    size: int
    packed: str


@dataclass
class Page:
    """One report under construction."""

    tables: Tables
    styles: dict[str, Style]
    folder: Path  # where static figures go
    figures: dict[str, Figure] = field(default_factory=dict)
    downloads: dict[str, Download] = field(default_factory=dict)

    def add_figure(self, figure: Figure) -> Figure:
        self.figures[figure.id] = figure
        return figure

    def add_download(self, name: str, content: bytes, description: str) -> Download:
        download = Download(name, description, len(content), pack(content))
        self.downloads[name] = download
        return download


def pack(content: bytes) -> str:
    """gzip + base64, undone in the page by the browser's own decompressor."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def pack_json(value: Any) -> str:
    text = json.dumps(_plain(value), separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return pack(text.encode("utf-8"))


def _plain(value: Any) -> Any:
    """NaN and infinities become null, numpy scalars Python numbers, floats six digits."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
