"""Mode ``full`` in 3D."""

from dcreg.families.mode import Mode
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.cover import CongruentCover
from dcreg.families.rigid3d.space import Rigid3D

MODE = Mode(
    "searches translation and rotation together; certifies the rigid pose",
    Rigid3D.between,
    make_bound=RigidBound,
    make_cover=CongruentCover,
    own_bound="rigid",
    stage="rigid",
)
