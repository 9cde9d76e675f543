"""Transformation models: parameters, start box, admissible set, local refinement, pose."""

from dcreg.models.base import Model
from dcreg.models.similarity2d import Similarity2D
from dcreg.models.translation3d import Translation3D

__all__ = ["Model", "Similarity2D", "Translation3D"]
