"""Bounding functions by name. ``a+b`` is the greater of two bounds, box by box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dcreg.families.dc.bounds import EdgeBound, PaperBound, SharedBound, TightBound, TightExactBound
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import SpaceBound, Strongest
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.names import BOUND_NAMES, DEFAULT_BOUND, bound_names
from dcreg.problem.problem import InputError, suggestion
from dcreg.search import Box


def bound_parts(name: str) -> list[str]:
    """Return the single bounds that are joined in `name`.

    Raises
    ------
    InputError
        For an unknown name, listing the known ones.
    """
    parts = name.split("+")
    unknown = [part for part in parts if part not in BOUND_NAMES]
    if unknown:
        raise InputError(
            f"bound: {unknown[0]!r} is unknown{suggestion(unknown[0], bound_names())}; some may be "
            "joined with '+'"
        )
    return parts


# Over similarities in the plane and translations in norm space; the other spaces have one bound each.
BOUNDS: dict[str, type[SpaceBound[Any]]] = {
    "tight": TightBound,
    "tight-exact": TightExactBound,
    "shared": SharedBound,
    "paper": PaperBound,
    "edges": EdgeBound,
}

__all__ = [
    "BOUNDS",
    "DEFAULT_BOUND",
    "RigidBound",
    "RotationBound",
    "SpaceBound",
    "Strongest",
    "bound_names",
    "bound_parts",
    "make_bound",
]


def make_bound(
    name: str, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
) -> SpaceBound[Any] | Strongest:
    """The bound called `name` over boxes made of `roots` (default: those of `space`).

    Names joined by ``+`` compete.

    Raises
    ------
    InputError
        For an unknown name.
    """
    made = [BOUNDS[part](space, roots, threads) for part in bound_parts(name)]
    return made[0] if len(made) == 1 else Strongest(made)
