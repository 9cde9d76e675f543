"""Ranges of the means of subsets of points: where an optimal translation can lie."""

from __future__ import annotations

from typing import Any

import numpy as np


def means_of_subsets(
    points: np.ndarray, count: int, lightest: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return, per axis of (d, n) points, the minimum and maximum mean of any `count` of them.

    Means have weights from `lightest` to 1.
    """
    low = np.array([-mean_of_largest(-values, count, lightest) for values in points])
    high = np.array([mean_of_largest(values, count, lightest) for values in points])
    # if all points are taken, both are equal up to rounding, which may reverse their order
    return np.minimum(low, high), np.maximum(low, high)


def mean_of_largest(values: np.ndarray, count: int, lightest: float = 1.0) -> Any:
    """Return the maximum mean of any `count` numbers along the first axis.

    Means have weights from `lightest` to 1. The maximum gives the largest numbers the weight 1 and the
    others the weight `lightest`.
    """
    largest = np.sort(values, axis=0)[-count:]
    if lightest == 1.0:
        return largest.mean(axis=0)
    sums = np.cumsum(largest[::-1], axis=0)
    heavy = np.arange(1.0, count + 1.0).reshape(-1, *[1] * (values.ndim - 1))
    means = sums + lightest * (sums[-1] - sums)
    return (means / (heavy + lightest * (count - heavy))).max(axis=0)
