"""Mode ``paper`` in 3D."""

from dcreg.families.mode import Mode
from dcreg.families.rotation3d.search import search_rotation
from dcreg.families.translation3d.space import Translation3D

MODE = Mode(
    "searches a translation in norm space, then a rotation for it; certifies the translation",
    Translation3D,
    rotation=search_rotation,
    in_norm_space=True,
    certifies="translation3d",
)
