"""The cheapest k pairs of numbers on a line, for many lists of numbers at once.

Squared differences of two sorted lists are least where pairs do not cross. Such a matching is a path
through the grid of both lists: a step passes over one number, or over one of each list, which pairs them.
At a price per pair the cheapest path is a dynamic programme. With k prices added it costs no more than
any k pairs (weak duality), and as much as the cheapest k where it has k pairs itself.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

MAX_CELLS = 1 << 20  # numbers held at once
TINY = 1e-200  # costs that may count as nothing


class Line:
    """k pairs of n numbers that change with m sorted ones that do not.

    Parameters
    ----------
    values : (m,) array
        In ascending order.
    n, k : int
    """

    def __init__(self, values: np.ndarray, n: int, k: int) -> None:
        self.n, self.m, self.k = n, len(values), k
        # a path through (i, j) with k pairs has j - i in between: it leaves out n - k and m - k numbers
        low, high = k - n, self.m - k
        self._margin = high - low  # at least 1
        self._values = np.pad(values, self._margin)
        self._least, self._most = values[0], values[-1]
        # of the places on the path with an even and with an odd i + j: the least j - i, and how many
        self._first = low + (low % 2), low + (low + 1) % 2
        self._width = tuple((high - first) // 2 + 1 for first in self._first)
        self._price = 0.0  # what settled the last lists

    def bounds(self, near: np.ndarray, far: np.ndarray, needed: float) -> np.ndarray:
        """Lower bounds on the least sum of k squared distances of `values` to intervals.

        A bound that reaches `needed`, or cannot, is not improved further. Otherwise it is the least sum
        itself, but for rounding downwards.

        Parameters
        ----------
        near, far : (B, n) arrays
            Ends of the intervals of each list, both in ascending order.
        needed : float
            At most what matters.
        """
        out = np.empty(len(near))
        size = max(1, MAX_CELLS // (self.n * (self._margin + 1)))
        for at in range(0, len(near), size):
            part = slice(at, at + size)
            out[part] = self._bounds(near[part].T, far[part].T, needed)
        return out

    def _bounds(self, near: np.ndarray, far: np.ndarray, needed: float) -> np.ndarray:
        """Of (n, B) intervals: the best price of a pair is where the cheapest path has k pairs.

        With k prices added the path's cost is a concave function of the price, with the slope k less
        the number of pairs. Its tangents on both sides of the maximum meet at the next price to try.
        """
        farthest = max(far.max() - self._least, self._most - near.min(), 0.0)
        top = max(min(needed, farthest**2), TINY)
        # Costs are whole numbers, rounded down, less one `label` per pair: so no sum is rounded, and a
        # path tells how many pairs it has.
        label = 0.5 ** min(self.n, self.m).bit_length()
        unit = top * self.n / label / 2.0**52
        costs = self._costs(near, far, unit, top)
        hopeless = needed if needed < np.inf else -np.inf
        count = near.shape[1]
        best, settled, left = np.zeros(count), np.empty(count), np.arange(count)
        charged = np.full(count, -label)
        start = min(self._price or 2.0 * top / self.k, top)
        price = np.full(count, max(1.0, start // unit))  # of nothing there is no double
        # where on either side, the value and the slope there; a path without pairs costs nothing
        rising = np.zeros((3, count))
        rising[2] = self.k
        falling = np.full((3, count), np.nan)
        while left.size:
            for cost in costs:
                cost -= price - charged
            path = self._cheapest_path(costs)
            value = np.ceil(path)
            slope = self.k - (value - path) / label
            tangent = np.array([price, value + self.k * price, slope])
            best[left], settled[left] = np.maximum(best[left], tangent[1]), price
            rising = np.where(slope > 0, tangent, rising)
            falling = np.where(slope < 0, tangent, falling)
            new, reach = _meeting(rising, falling)
            new = np.minimum(np.where(np.isnan(new), 2.0 * price, np.rint(new)), top // unit)
            goes_on = (
                (slope != 0) & (best[left] * unit < needed) & ~(reach * unit < hopeless)
                & (new > rising[0]) & ~(new >= falling[0])
            )  # fmt: skip
            left, charged, price = left[goes_on], price[goes_on], new[goes_on]
            if not goes_on.all():
                rising, falling = rising[:, goes_on], falling[:, goes_on]
                costs = [cost[..., goes_on] for cost in costs]
        self._price = float(np.median(settled)) * unit
        return best * unit

    def _costs(
        self, near: np.ndarray, far: np.ndarray, unit: float, top: float
    ) -> list[np.ndarray]:
        """Costs, in whole units and at most `top`, of a step to (i, j) that pairs the numbers before it.

        Two (levels, width, B) arrays, for even and odd i + j: one level for each sum from 1 on, and in it
        the places in ascending order of j - i. Places outside of the grid have some cost; no path to its
        last corner passes them.
        """
        pad = ((self._margin, self._margin), (0, 0))
        scale = unit**-0.5
        near, far = np.pad(scale * near, pad), np.pad(scale * far, pad)
        numbers = scale * self._values
        costs = []
        for parity, first, width in zip((0, 1), self._first, self._width, strict=True):
            n_levels, level = (self.n + self.m + parity) // 2, 2 - parity
            i = self._margin + (level - first) // 2 - width  # the least of the first level
            j = self._margin + (level + first) // 2 - 1
            rows, columns = slice(i, i + n_levels + width - 1), slice(j, j + n_levels + width - 1)
            values = sliding_window_view(numbers[columns], width)[..., None]
            low, high = (
                sliding_window_view(ends[rows], width, axis=0)[..., ::-1].transpose(0, 2, 1)
                for ends in (near, far)
            )
            cost = low - values
            np.maximum(cost, values - high, out=cost)
            np.maximum(cost, 0.0, out=cost)
            cost *= cost
            np.minimum(cost, top / unit, out=cost)
            costs.append(np.floor(cost, out=cost))
        return costs

    def _cheapest_path(self, costs: list[np.ndarray]) -> np.ndarray:
        """(B,) costs of the cheapest paths from (0, 0) to (n, m)."""
        # the latest place of either parity, between places that no path reaches
        costs_so_far = [np.full((width + 2, costs[0].shape[2]), np.inf) for width in self._width]
        costs_so_far[0][1 - self._first[0] // 2] = 0.0
        low = min(self._first)
        for level in range(1, self.n + self.m + 1):
            parity = level % 2
            own, before = costs_so_far[parity][1:-1], costs_so_far[1 - parity]
            at, width = self._first[parity] - low, self._width[parity]
            own += costs[parity][(level - 1) // 2]
            np.minimum(own, before[at : at + width], out=own)
            np.minimum(own, before[at + 1 : at + 1 + width], out=own)
        return own[(self.m - self.n - self._first[parity]) // 2]


def _meeting(rising: np.ndarray, falling: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where two tangents (place, value, slope) meet, and their value there."""
    (at, low, rise), (end, high, fall) = rising, falling
    place = (high - low + rise * at - fall * end) / (rise - fall)
    return place, low + rise * (place - at)
