"""The tuple in which kernels receive a problem."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.jit import jit


class Clouds(NamedTuple):
    """Both clouds of a problem, by axis, and what else its kernels need.

    Attributes
    ----------
    source : (d, n) array
    target : (d, m) array, or (m,) array of norms
        The number of dimensions tells norms from points when a kernel is compiled.
    prices : (n, m) array, or (0, 0) if every pair is feasible
        What a pair costs in addition to its residual: 0, or prohibitive.
    k : int
        Number of pairs to match.
    stop : (1,) uint8 array
        Set from another thread; a kernel then returns at once, with incomplete output.
    """

    source: np.ndarray
    target: np.ndarray
    prices: np.ndarray
    k: int
    stop: np.ndarray


@jit
def add_prices(prices, costs):
    """Add what pairs cost beyond their residual to (n, m) costs; nothing where `prices` is empty."""
    for i in range(prices.shape[0]):
        for j in range(prices.shape[1]):
            costs[i, j] += prices[i, j]
