"""Mode ``full`` in 3D."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dcreg.families.mode import Mode
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D

if TYPE_CHECKING:
    from dcreg.families.rigid3d.cover import CongruentCover


def make_cover(space: Rigid3D, threads: int = 1) -> CongruentCover:
    """Return the cover of a long search. It is imported here, because few searches need it."""
    from dcreg.families.rigid3d.cover import CongruentCover

    return CongruentCover(space, threads)


def in_region() -> tuple[Any, Any]:
    """Return the space of the poses in a region, and its bound."""
    from dcreg.families.rigid3d.region import RegionBound, rigid_in_region

    return rigid_in_region, RegionBound


MODE = Mode(
    "searches translation and rotation together; certifies the rigid pose",
    Rigid3D.between,
    make_bound=RigidBound,
    make_cover=make_cover,
    own_bound="rigid",
    certifies="rigid3d",
    in_region=in_region,
    stage="rigid",
)
