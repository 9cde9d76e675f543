"""A page under construction: figures, downloads and packed data."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from dcreg.files import plain
from reports.figures import printing
from reports.figures.figure import Figure
from reports.measured import Measured
from reports.tables import Tables
from reports.theme import Style


@dataclass(frozen=True)
class Download:
    """A file that the reader can save from the page."""

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

    @cached_property
    def measured(self) -> Measured:
        return Measured.of_tables(self.tables)

    def add_figure(self, figure: Figure) -> Figure:
        self.figures[figure.id] = figure
        return figure

    def add_print(
        self, figure: Figure, view: str, roles: Collection[str], name: str, text: str
    ) -> list[Download]:
        """Add a view of a figure as SVG and PDF, both as files next to the page and as downloads."""
        assert figure.grid is not None
        drawing = printing.draw(
            figure.payload["views"][view]["data"], figure.grid, self.styles,
            f"{self.tables.experiment}: {text}", roles, photographs=figure.photographs,
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
    """Compress and encode `content`; the browser undoes it in the page."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def pack_json(value: Any) -> str:
    """Pack `value` as JSON with six significant digits."""
    content = plain(value, digits=6)
    return pack(json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode("utf-8"))
