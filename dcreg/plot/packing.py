"""Packed data inside a page: compressed, as text, unpacked by the browser.

``unpack.js`` next to this module is the other half.
"""

from __future__ import annotations

import base64
import functools
import gzip
import json
from pathlib import Path
from typing import Any

from plotly.offline import get_plotlyjs

UNPACK = Path(__file__).with_name("unpack.js")


def pack(content: bytes) -> str:
    """Return `content` as text that may stand in a script of a page: gzip, then base 85 (RFC 1924).

    Base 85 adds 25 % where base 64 adds 33 %.
    """
    return base64.b85encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def unpack(text: str) -> bytes:
    """Return the content of a packed text."""
    return gzip.decompress(base64.b85decode(text))


def pack_json(value: Any) -> str:
    """Return `value`, which holds only what JSON knows, as packed JSON."""
    return pack(json.dumps(value, separators=(",", ":"), ensure_ascii=False).encode("utf-8"))


@functools.cache
def packed_plotly() -> str:
    """Return plotly.js of the installed package, packed."""
    return pack(get_plotlyjs().encode("utf-8"))
