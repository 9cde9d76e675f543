"""Bounds of the library's kind over single boxes, for comparisons (`baselines.contract.BoxBounding`)."""

from __future__ import annotations

import numpy as np

from baselines.contract import Instance
from dcreg.box import Box
from dcreg.models import Model, Similarity2D, Translation3D
from dcreg.search import Bound


def box_model(instance: Instance, lower: np.ndarray, upper: np.ndarray) -> Model:
    """The model over the instance's own coordinates, of similarities or norm space, from this box on."""
    source, target = (
        np.array(points, dtype=float, order="C") for points in (instance.source, instance.target)
    )
    model: Model
    if instance.dim == 2:
        model = Similarity2D(source, target, instance.n_inliers, instance.scale_range)
    else:
        model = Translation3D(source, target, instance.n_inliers)
    model.start_box = lambda: Box(lower, upper)  # type: ignore[method-assign]
    return model


def bound_of_box(bound: Bound, lower: np.ndarray, upper: np.ndarray) -> float:
    return float(bound.evaluate(lower[None], upper[None], np.inf).lower_bounds[0])
