"""Names of the bounding functions, apart from their code: nothing compiled is loaded for a name."""

from __future__ import annotations

from dcreg.problem.errors import InputError

BOUND_NAMES = (
    "tight",
    "tight-exact",
    "shared",
    "paper",
    "edges",
    "termwise-r1",
    "termwise-r2",
    "termwise-r3",
)
ALIASES = {"termwise": "termwise-r1+termwise-r2"}
DEFAULT_BOUND = "tight"


def bound_names() -> list[str]:
    """What `--bound` takes, beside combinations ``a+b``."""
    return [*BOUND_NAMES, *ALIASES]


def bound_parts(name: str) -> list[str]:
    """The single bounds that `name` stands for.

    Raises
    ------
    InputError
        For an unknown name, listing the known ones.
    """
    parts = ALIASES.get(name, name).split("+")
    unknown = [part for part in parts if part not in BOUND_NAMES]
    if unknown:
        raise InputError(
            f"bound: {unknown[0]!r} is unknown; choose from {bound_names()} or join some with '+'"
        )
    return parts
