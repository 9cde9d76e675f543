"""Shared parts of initial poses: a score by nearness to the target, a choice of distinct poses."""

from __future__ import annotations

import numpy as np

from dcreg.families.kernels import NearnessField, fill_nearness

CELLS_PER_REACH = 3.0


def nearness_field(target: np.ndarray, reach: float, max_cells: int) -> NearnessField:
    """Return the field of (m, 2) or (m, 3) target points.

    Parameters
    ----------
    target : (m, d) array
    reach : float
        Distance beyond which a point is not near the target. It is increased if an outlier point would
        otherwise cost more than `max_cells` cells along an axis.
    max_cells : int
    """
    extent = float(np.ptp(target, axis=0).max())
    reach = max(reach, CELLS_PER_REACH * extent / max_cells)
    cell = reach / CELLS_PER_REACH
    size = int(np.ceil((extent + 2.0 * reach) / cell)) + 1
    dim = target.shape[1]
    origin = np.full(
        3, -0.5 * cell
    )  # in 2D the points lie at the centres of the one layer of cells
    origin[:dim] = target.min(axis=0) - reach
    field = NearnessField(origin, cell, np.zeros((size, size, size if dim == 3 else 1), np.uint8))
    fill_nearness(in_3d(target), reach, field)
    return field


def in_3d(points: np.ndarray) -> np.ndarray:
    """Return (n, d) points as (n, 3), with zeros for a missing axis."""
    return np.ascontiguousarray(np.pad(points, ((0, 0), (0, 3 - points.shape[1]))))


def distinct(
    coordinates: np.ndarray, scores: np.ndarray, separation: float, count: int
) -> list[int]:
    """Return the rows with the highest scores that differ, best first, at most `count`.

    Rows differ if one of their coordinates differs by more than `separation`. Scores are positive.
    """
    kept: list[int] = []
    for at in np.argsort(-scores, kind="stable"):
        if scores[at] <= 0.0 or len(kept) == count:
            break
        differences = np.abs(coordinates[kept] - coordinates[at]).max(axis=1, initial=0.0)
        if (differences > separation).all():
            kept.append(int(at))
    return kept
