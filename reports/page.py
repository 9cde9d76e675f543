"""What sections add to while a page is built: figures, downloads and packed data."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reports.figures import printing
from reports.figures.grid import Grid
from reports.tables import Tables
from reports.theme import Style


@dataclass(frozen=True)
class Figure:
    """An interactive figure: data for one of the builders in ``assets/report.js``."""

    id: str
    title: str
    builder: str
    payload: dict[str, Any]
    grid: Grid | None = None  # of figures that also go to print

    @property
    def heights(self) -> dict[str, int]:
        """Pixels of the wide and the narrow arrangement: room to keep until the figure is drawn."""
        first = next(iter(self.payload.get("views", {}).values()), self.payload)
        return {name: layout["height"] for name, layout in first["layouts"].items()}

    @property
    def methods(self) -> set[str]:
        """Labels of the methods that any view of the figure draws."""
        drawn = [trace for view in self.payload.get("views", {}).values() for trace in view["data"]]
        return {trace["meta"]["method"] for trace in drawn if "method" in trace["meta"]}


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

    def add_print(
        self, figure: Figure, view: str, roles: Collection[str], name: str, text: str
    ) -> list[Download]:
        """A view of a figure as SVG and PDF: files beside the page, and downloads within it."""
        assert figure.grid is not None
        drawing = printing.draw(
            figure.payload["views"][view]["data"], figure.grid, self.styles,
            f"{self.tables.experiment}: {text}", roles,
        )  # fmt: skip
        return [
            self.add_download(path.name, path.read_bytes(), f"{text}, {path.suffix[1:].upper()}")
            for path in printing.save(drawing, self.folder / name)
        ]

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
