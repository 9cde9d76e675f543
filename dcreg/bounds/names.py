"""What a name, or several joined by ``+``, stands for."""

from __future__ import annotations

from dcreg.names import BOUND_ALIASES, BOUND_NAMES, bound_names
from dcreg.problem.errors import InputError, suggestion


def bound_parts(name: str) -> list[str]:
    """The single bounds that `name` stands for.

    Raises
    ------
    InputError
        For an unknown name, listing the known ones.
    """
    parts = [part for word in name.split("+") for part in BOUND_ALIASES.get(word, word).split("+")]
    unknown = [part for part in parts if part not in BOUND_NAMES]
    if unknown:
        raise InputError(
            f"bound: {unknown[0]!r} is unknown{suggestion(unknown[0], bound_names())}; some may be "
            "joined with '+'"
        )
    return parts
