"""What kernels know of a problem: one tuple in place of its arrays one by one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.jit import jit


class Points(NamedTuple):
    """A problem over plane points, or over norms of points in space.

    Attributes
    ----------
    source : (n, 2) or (n, 3) array
    axes : (2, n) or (3, n) array
        The source by axis: loops over the points run along memory.
    target : (2, m) array, or (m,) array of norms
        The number of dimensions tells the two problems apart when a kernel is compiled, so that each
        compiles its own half only.
    prices : (n, m) array, or (0, 0) where every pair is feasible
        What a pair costs beyond its residual: 0, or prohibitive.
    k : int
        Pairs to be matched.
    stop : (1,) uint8 array
        Set from outside once a kernel shall return at once, whatever it then returns.
    """

    source: np.ndarray
    axes: np.ndarray
    target: np.ndarray
    prices: np.ndarray
    k: int
    stop: np.ndarray


class Clouds(NamedTuple):
    """A problem over points in space.

    Attributes
    ----------
    source, target : (3, n), (3, m) arrays
        By axis.
    prices : (n, m) array, or (0, 0) where every pair is feasible
        What a pair costs beyond its residual: 0, or prohibitive.
    k : int
        Pairs to be matched.
    stop : (1,) uint8 array
        Set from outside once a kernel shall return at once, whatever it then returns.
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
