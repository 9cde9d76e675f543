"""Parameter spaces: what is searched, its start box, its admissible set, its local refinement."""

from dcreg.spaces.base import Space
from dcreg.spaces.features import FeatureSpace
from dcreg.spaces.rigid3d import Rigid3D
from dcreg.spaces.rotation3d import Rotation3D
from dcreg.spaces.similarity2d import Similarity2D
from dcreg.spaces.translation3d import Translation3D

__all__ = [
    "FeatureSpace",
    "Rigid3D",
    "Rotation3D",
    "Similarity2D",
    "Space",
    "Translation3D",
]
