"""A page under construction: figures, downloads and packed data."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from dcreg.files import plain
from dcreg.plot import packing
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


MOST_PRINTED = 50  # methods of a figure for print
MOST_FILES = 100  # of data, next to a page
DATA = "data"  # their folder


@dataclass
class Page:
    """One report under construction.

    Attributes
    ----------
    tables : Tables
    styles : dict of str to Style
    folder : Path
        Where static figures go.
    figures : dict of str to Figure
    downloads : dict of str to Download
    data : dict of str to str
        Packed content by name. A page loads ``data/NAME.js`` when it needs it, as a script, because a
        page that is opened from a disk can load nothing else.
    parts : dict of str to list of str
        The content of closed parts of each section, as HTML, which a page shows when they are opened.
    """

    tables: Tables
    styles: dict[str, Style]
    folder: Path
    figures: dict[str, Figure] = field(default_factory=dict)
    downloads: dict[str, Download] = field(default_factory=dict)
    data: dict[str, str] = field(default_factory=dict)
    parts: dict[str, list[str]] = field(default_factory=dict)

    @cached_property
    def measured(self) -> Measured:
        return Measured.of_tables(self.tables)

    def add_figure(self, figure: Figure) -> Figure:
        self.figures[figure.id] = figure
        return figure

    def add_print(
        self, figure: Figure, view: str, roles: Collection[str], name: str, text: str
    ) -> list[Download]:
        """Add a view of a figure as SVG and PDF, both as files next to the page and as downloads.

        There are no files for more than `MOST_PRINTED` methods, whose lines cannot be distinguished.
        """
        from reports.figures import printing  # takes long to load

        assert figure.grid is not None
        if len(self.styles) > MOST_PRINTED:
            return []
        drawing = printing.draw(
            figure.payload["views"][view]["data"], figure.grid, self.styles,
            f"{self.tables.experiment}: {text}", roles, photographs=figure.photographs,
        )  # fmt: skip
        return [
            self.add_download(path.name, path.read_bytes(), f"{text}, {path.suffix[1:].upper()}")
            for path in printing.save(drawing, self.folder / name)
        ]

    def add_download(self, name: str, content: bytes, description: str) -> Download:
        download = Download(name, description, len(content))
        self.downloads[name] = download
        self.data[f"file-{name}"] = packing.pack(content)
        return download

    def add_part(self, section: str, html: str) -> int:
        """Add the content of a closed part; return its number in the section."""
        known = self.parts.setdefault(section, [])
        known.append(html)
        return len(known) - 1

    def packed(self) -> dict[str, str]:
        """Return all data of the page, figures, closed parts and plotly.js, packed."""
        figures = {f"figure-{name}": pack_json(one.payload) for name, one in self.figures.items()}
        parts = {f"parts-{name}": packing.pack_json(html) for name, html in self.parts.items()}
        return {**self.data, **figures, **parts, "plotly": packing.packed_plotly()}


def write_data(packed: Mapping[str, str], folder: Path) -> None:
    """Write packed data to ``folder/data``, in place of earlier files."""
    assert len(packed) <= MOST_FILES
    assert all(re.fullmatch(r"[\w.-]+", name) for name in packed)
    place = folder / DATA
    place.mkdir(parents=True, exist_ok=True)
    for path in place.glob("*.js"):
        path.unlink()
    for name, text in packed.items():
        (place / f"{name}.js").write_text(f'store("{name}", "{text}");\n', "ascii")


def pack_json(value: Any) -> str:
    """Pack `value` as JSON with six significant digits."""
    return packing.pack_json(plain(value, digits=6))
