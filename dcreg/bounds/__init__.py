"""Bounding functions by name. ``a+b`` is the greater of two bounds, box by box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dcreg.bounds.base import SpaceBound, Strongest
from dcreg.bounds.dc import PaperBound
from dcreg.bounds.dc_shared import SharedBound, TightBound, TightExactBound
from dcreg.bounds.edges import EdgeBound
from dcreg.bounds.names import bound_parts
from dcreg.bounds.rigid3d import RigidBound
from dcreg.bounds.rotation3d import RotationBound
from dcreg.bounds.termwise import TermwiseR1, TermwiseR2
from dcreg.bounds.termwise_lp import TermwiseR3
from dcreg.names import DEFAULT_BOUND, bound_names
from dcreg.search import Box
from dcreg.spaces import FeatureSpace

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
