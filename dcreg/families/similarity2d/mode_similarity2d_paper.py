"""Mode ``paper`` in 2D."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dcreg.families.mode import Mode
from dcreg.families.similarity2d.space import Similarity2D

if TYPE_CHECKING:
    from dcreg.families.similarity2d.cover import NearestCover


def make_cover(space: Similarity2D, threads: int = 1) -> NearestCover:
    """Return the cover of a long search. It is imported here, because few searches need it."""
    from dcreg.families.similarity2d.cover import NearestCover

    return NearestCover(space, threads)


def in_region() -> tuple[Any, None]:
    """Return the space of the poses in a region; the bounds are the usual ones."""
    from dcreg.families.similarity2d.region import similarity_in_region

    return similarity_in_region, None


MODE = Mode(
    "searches the similarity; certifies the pose",
    Similarity2D,
    needs=("scale_range",),
    make_cover=make_cover,
    certifies="similarity2d",
    in_region=in_region,
    takes_weights=True,
)
