"""Bounding functions by name, found in the folders of the families.

A module of a family whose name begins with ``bound`` is searched for subclasses of `SpaceBound` that have
a `name`; they bound the spaces of their `space_type`. A new bound is thus one new file. ``a+b`` is the
maximum of two bounds, box by box.
"""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dcreg.families.protocol import Space, SpaceBound, Strongest
from dcreg.names import bound_names, bounds_in
from dcreg.problem import InputError, suggestion
from dcreg.search import Box


@functools.cache
def all_bounds() -> tuple[type[SpaceBound[Any]], ...]:
    """Return the bounds of all families that have a name."""
    return tuple(_find_bounds())


def _find_bounds(named: Sequence[str] | None = None) -> Iterator[type[SpaceBound[Any]]]:
    """Yield the bounds of all files, or of the files that define one of some names."""
    here = Path(__file__).parent
    for path in sorted(here.glob("*/bound*.py")):
        if named is not None and not bounds_in(path).intersection(named):
            continue
        module = importlib.import_module(f"{__package__}.{path.parent.name}.{path.stem}")
        for _, member in inspect.getmembers(module, inspect.isclass):
            is_defined_here = member.__module__ == module.__name__
            if is_defined_here and issubclass(member, SpaceBound) and member.name:
                yield member


@functools.cache
def bounds_of(space: type[Space]) -> dict[str, type[SpaceBound[Any]]]:
    """Return the bounds over a type of space, by name."""
    return {bound.name: bound for bound in all_bounds() if issubclass(space, bound.space_type)}


def bound_parts(name: str) -> list[str]:
    """Return the single bounds that are joined in `name`.

    Raises
    ------
    InputError
        For an unknown name.
    """
    parts = name.split("+") if isinstance(name, str) else [name]
    unknown = [part for part in parts if part not in bound_names()]
    if unknown:
        raise InputError(
            f"bound: {unknown[0]!r} is unknown{suggestion(unknown[0], bound_names())}; several can be "
            "joined by '+'"
        )
    return parts


def make_bound(
    name: str, space: Space, roots: Sequence[Box] | None = None, threads: int = 1
) -> SpaceBound[Any] | Strongest:
    """Return the bound called `name` over boxes made of `roots` (default: those of `space`).

    Names joined by ``+`` give the maximum of their bounds.

    Raises
    ------
    InputError
        For a name that is not a bound over this space.
    """
    # files of other bounds are not imported
    wanted = name.split("+") if isinstance(name, str) else []
    known = {
        bound.name: bound for bound in _find_bounds(wanted) if isinstance(space, bound.space_type)
    }
    if not wanted or set(wanted).difference(known):
        known = bounds_of(type(space))
    parts = [name] if name in known else bound_parts(name)
    if missing := [part for part in parts if part not in known]:
        raise InputError(
            f"bound: {missing[0]!r} does not bound this space ({space.scope}); choose from "
            f"{', '.join(known)}"
        )
    made = [known[part](space, roots, threads) for part in parts]
    return made[0] if len(made) == 1 else Strongest(made)
