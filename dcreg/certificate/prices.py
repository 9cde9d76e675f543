"""Assignments and their prices: what one solved assignment says about others with similar costs.

With prices on the targets, k source points that each take the cheapest target pay, less all the prices,
no more than any one-to-one matching costs (weak duality). The prices of an assignment make the two equal,
and those of its neighbours nearly so: most parameters need no assignment of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

NEIGHBOURS = 4  # whose prices are averaged


class Profile(NamedTuple):
    """A lower bound on the objective at one parameter, taken apart by source points.

    It stays one where every point has a rebate of its own: ``sum_of_smallest(rows - rebates) - total``.

    Attributes
    ----------
    rows : (r,) array
        What each source point pays at least; where all rebates are the same, their least sum alone.
    total : float
        Sum of the prices.
    is_exact : bool
        Whether the bound is the objective itself.
    """

    rows: np.ndarray
    total: float
    is_exact: bool


def sum_of_smallest(values: np.ndarray, k: int) -> np.ndarray:
    """Sum of the k smallest along the last axis."""
    if k == values.shape[-1]:
        return values.sum(axis=-1)
    return np.partition(values, k - 1, axis=-1)[..., :k].sum(axis=-1)


def cheapest_pairs(cost: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The k cheapest pairs, one per row and column, of (n, m) costs that are not negative.

    Returns
    -------
    (n, m + n - k) array
        The costs, with free columns for the rows that stay without a partner.
    (n,) int array
        The column of each row there.
    """
    n, _ = cost.shape
    cost = np.hstack([cost, np.zeros((n, n - k))])
    return cost, linear_sum_assignment(cost)[1]


def prices_of(cost: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Prices of the columns, at which all rows of an optimal assignment are content: lengths of paths."""
    potential = np.zeros(cost.shape[1])
    rise = cost - np.take_along_axis(cost, columns[:, None], axis=1)
    for _ in columns:  # a shortest path passes each row once at most
        lowered = np.minimum(potential, (rise + potential[columns, None]).min(axis=0))
        if (lowered == potential).all():
            break
        potential = lowered
    return -potential


class Prices:
    """The prices of the parameters whose assignment was solved.

    Parameters
    ----------
    weights : (d,) array
        Units of the axes, for distances between parameters.
    n_targets : int
    """

    def __init__(self, weights: np.ndarray, n_targets: int) -> None:
        self._weights = weights
        self._used = 0
        self._thetas, self._prices = np.empty((64, len(weights))), np.empty((64, n_targets))
        self._sizes = np.empty(64)  # |theta|^2

    def add(self, theta: np.ndarray, prices: np.ndarray) -> None:
        """Remember the prices at `theta`."""
        if self._used == len(self._thetas):
            self._thetas = np.concatenate([self._thetas, np.empty_like(self._thetas)])
            self._prices = np.concatenate([self._prices, np.empty_like(self._prices)])
            self._sizes = np.concatenate([self._sizes, np.empty_like(self._sizes)])
        self._thetas[self._used] = theta = self._weights * theta
        self._sizes[self._used] = theta @ theta
        self._prices[self._used] = prices
        self._used += 1

    def near(self, theta: np.ndarray) -> np.ndarray:
        """The mean of the prices nearest to `theta`; zero while there are none."""
        if self._used <= NEIGHBOURS:
            return self._prices[: self._used].mean(axis=0) if self._used else np.zeros(1)
        # squared distances, less the same for all
        off = self._sizes[: self._used] - self._thetas[: self._used] @ (2.0 * self._weights * theta)
        return self._prices[np.argpartition(off, NEIGHBOURS)[:NEIGHBOURS]].mean(axis=0)
