"""Bounds over single boxes, for comparisons of bounds."""

from __future__ import annotations

import numpy as np

from baselines.contract import Instance
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import MakeBound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box, Boxes


def box_space(instance: Instance) -> FeatureSpace:
    """Return the library's space over the instance's own coordinates: similarities, or norm space."""
    source, target = (
        np.array(points, dtype=float, order="C") for points in (instance.source, instance.target)
    )
    if instance.dim == 2:
        return Similarity2D(source, target, instance.n_inliers, instance.scale_range)
    return Translation3D(source, target, instance.n_inliers)


def bound_of_box(make: MakeBound, space: FeatureSpace, box: Box) -> tuple[float, int]:
    """Return the full-strength bound of one box, as if the search began there, and its assignments.

    Parameters
    ----------
    make : callable
        From ``(space, roots)`` to a bound.
    space : FeatureSpace
    box : Box
    """
    bound = make(space, [box])
    found = bound.evaluate(Boxes.of([box]), None)
    return float(found.lower_bounds[0]), bound.n_assignments
