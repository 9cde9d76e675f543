"""Bounds of the library's kind over single boxes, for comparisons (`baselines.contract.BoxBounding`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from baselines.contract import Instance
from dcreg.search import Bound, Box
from dcreg.spaces import Similarity2D, Space, Translation3D


def box_model(instance: Instance) -> Space:
    """The library's model over the instance's own coordinates: of similarities, or of norm space."""
    source, target = (
        np.array(points, dtype=float, order="C") for points in (instance.source, instance.target)
    )
    if instance.dim == 2:
        return Similarity2D(source, target, instance.n_inliers, instance.scale_range)
    return Translation3D(source, target, instance.n_inliers)


def bound_of_box(
    make: Callable[[Space], Bound], instance: Instance, lower: np.ndarray, upper: np.ndarray
) -> float:
    """What the bound made for the instance's model says of one box, as if searching from there."""
    model = box_model(instance)
    model.start_box = lambda: Box(lower, upper)  # type: ignore[method-assign]
    return float(make(model).evaluate(lower[None], upper[None], np.inf).lower_bounds[0])
