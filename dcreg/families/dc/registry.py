"""Bounding functions by name. ``a+b`` is the greater of two bounds, box by box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dcreg.families.dc.bounds import EdgeBound, PaperBound, SharedBound, TightBound, TightExactBound
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.dc.termwise import TermwiseR1, TermwiseR2
from dcreg.families.dc.termwise_lp import TermwiseR3
from dcreg.families.protocol import SpaceBound, Strongest
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.names import BOUND_ALIASES, BOUND_NAMES, DEFAULT_BOUND, bound_names
from dcreg.problem.problem import InputError, suggestion
from dcreg.search import Box


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


# Over similarities in the plane and translations in norm space; the other spaces have one bound each.
BOUNDS: dict[str, type[SpaceBound[Any]]] = {
    "tight": TightBound,
    "tight-exact": TightExactBound,
    "shared": SharedBound,
    "paper": PaperBound,
    "edges": EdgeBound,
    "termwise-r1": TermwiseR1,
    "termwise-r2": TermwiseR2,
    "termwise-r3": TermwiseR3,
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
