"""The environment in which the pages are rendered from ``templates/``, with the files of ``assets/``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import jinja2

from dcreg.plot import packing

HERE = Path(__file__).parent
NUMBER = re.compile(r"[+−-]?[\d.]+(?!\w)|–$")  # also with a unit or an interval, but not 2D


def environment() -> jinja2.Environment:
    """Return an environment that escapes values, refuses unknown names and has the function `asset`."""
    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.globals["asset"] = asset
    found.filters["numeric"] = numeric
    return found


def numeric(rows: Sequence[Sequence[str]]) -> list[bool]:
    """Return whether each column of a table of text contains numbers, which align to the right."""
    return [all(map(NUMBER.match, column)) for column in zip(*rows, strict=True)]


def asset(name: str) -> str:
    """Return the text of a file in ``assets/``."""
    return (HERE / "assets" / name).read_text(encoding="utf-8")


def script(*names: str) -> str:
    """Return scripts of ``assets/`` after what all of them need, as one script."""
    return "\n".join(
        [packing.UNPACK.read_text(encoding="utf-8"), *map(asset, ("common.js", *names))]
    )
