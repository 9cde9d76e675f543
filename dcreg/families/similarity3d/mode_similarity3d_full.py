"""Mode ``full`` of similarities in 3D. Searches of other models do not load its space and its bound."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dcreg.families.mode import Mode

if TYPE_CHECKING:
    from dcreg.families.similarity3d.bound import SimilarityBound
    from dcreg.families.similarity3d.space import Similarity3D


def make_space(*given: Any) -> Similarity3D:
    """Return the space; see `Similarity3D`."""
    from dcreg.families.similarity3d.space import Similarity3D

    return Similarity3D(*given)


def make_bound(space: Similarity3D, threads: int = 1) -> SimilarityBound:
    """Return the bound over a space."""
    from dcreg.families.similarity3d.bound import SimilarityBound

    return SimilarityBound(space, threads=threads)


MODE = Mode(
    "searches translation, rotation and scale together; certifies the similarity",
    make_space,
    needs=("scale_range",),
    make_bound=make_bound,
    own_bound="similarity",
    takes_weights=True,
    stage="similarity",
)
