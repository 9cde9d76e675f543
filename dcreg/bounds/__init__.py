"""Bounding functions by name. ``a+b`` is the greater of two bounds, box by box."""

from __future__ import annotations

from dcreg.bounds.base import ModelBound, Strongest
from dcreg.bounds.dc import PaperBound
from dcreg.bounds.edges import EdgeBound
from dcreg.bounds.joint_lp import TermwiseR3
from dcreg.bounds.shared import SharedBound, TightBound, TightExactBound
from dcreg.bounds.termwise import TermwiseR1, TermwiseR2
from dcreg.models import Model
from dcreg.problem import InputError

BOUNDS: dict[str, type[ModelBound]] = {
    "tight": TightBound,
    "tight-exact": TightExactBound,
    "shared": SharedBound,
    "paper": PaperBound,
    "edges": EdgeBound,
    "termwise-r1": TermwiseR1,
    "termwise-r2": TermwiseR2,
    "termwise-r3": TermwiseR3,
}
ALIASES = {"termwise": "termwise-r1+termwise-r2"}

__all__ = [
    "ALIASES",
    "BOUNDS",
    "ModelBound",
    "Strongest",
    "bound_names",
    "bound_parts",
    "make_bound",
]


def bound_names() -> list[str]:
    return [*BOUNDS, *ALIASES]


def bound_parts(name: str) -> list[str]:
    """The single bounds that `name` stands for.

    Raises
    ------
    InputError
        For an unknown name, listing the known ones.
    """
    parts = ALIASES.get(name, name).split("+")
    unknown = [part for part in parts if part not in BOUNDS]
    if unknown:
        raise InputError(
            f"bound: {unknown[0]!r} is unknown; choose from {bound_names()} or join some with '+'"
        )
    return parts


def make_bound(name: str, model: Model, threads: int = 1) -> ModelBound | Strongest:
    """The bound called `name` over `model`; names joined by ``+`` compete.

    Raises
    ------
    InputError
        For an unknown name.
    """
    made = [BOUNDS[part](model, threads) for part in bound_parts(name)]
    return made[0] if len(made) == 1 else Strongest(made)
