"""The environment in which the pages are rendered from ``templates/``, with the files of ``assets/``."""

from __future__ import annotations

from pathlib import Path

import jinja2

from dcreg.plot import packing

HERE = Path(__file__).parent


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
    return found


def asset(name: str) -> str:
    """Return the text of a file in ``assets/``."""
    return (HERE / "assets" / name).read_text(encoding="utf-8")


def script(*names: str) -> str:
    """Return scripts of ``assets/`` after what all of them need, as one script."""
    return "\n".join(
        [packing.UNPACK.read_text(encoding="utf-8"), *map(asset, ("common.js", *names))]
    )
