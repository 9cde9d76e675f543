"""Bounds of the library's kind over single boxes, for comparisons (`baselines.contract.BoxBounding`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from baselines.contract import Instance
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Bound, Box

# (space, roots) -> bound
MakeBound = Callable[[FeatureSpace, list[Box]], Bound]


def box_space(instance: Instance) -> FeatureSpace:
    """The library's space over the instance's own coordinates: similarities, or norm space."""
    source, target = (
        np.array(points, dtype=float, order="C") for points in (instance.source, instance.target)
    )
    if instance.dim == 2:
        return Similarity2D(source, target, instance.n_inliers, instance.scale_range)
    return Translation3D(source, target, instance.n_inliers)


def bound_of_box(
    make: MakeBound, instance: Instance, lower: np.ndarray, upper: np.ndarray
) -> float:
    """What a bound says of one box at its full strength, as if a search began there."""
    bound = make(box_space(instance), [Box(lower, upper)])
    found = bound.evaluate(lower[None], upper[None], np.inf, thorough=True)
    return float(found.lower_bounds[0])
