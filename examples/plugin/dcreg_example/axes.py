"""Rotations that align the principal axes of two point sets."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np


def rotations(source: np.ndarray, target: np.ndarray) -> Iterator[np.ndarray]:
    """Yield each rotation that maps the principal axes of `source` to those of `target`."""
    frames = [np.linalg.svd(points - points.mean(axis=0))[2].T for points in (source, target)]
    for signs in product((1.0, -1.0), repeat=source.shape[1]):
        rotation = frames[1] * signs @ frames[0].T
        if np.linalg.det(rotation) > 0:
            yield rotation
