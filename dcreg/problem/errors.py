"""Bad input, and how to say what was meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Bad input. The message names the field (and file), the value and the remedy."""


def suggestion(word: str, known: Iterable[str]) -> str:
    """``; did you mean 'x'? Known: …``, to be put behind a message about an unknown name."""
    known = sorted(map(str, known))
    close = difflib.get_close_matches(str(word), known, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    return f"{hint} known: {', '.join(known) or 'none'}"
