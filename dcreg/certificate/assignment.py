"""Cheapest one-to-one pairs: exact assignments with their duals, and pairs of numbers on a line."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

NEIGHBOURS = 4  # solved parameters whose duals are averaged
MAX_CELLS = 1 << 20  # numbers held at once on a line
ROUNDS = 5  # of an auction
TINY = 1e-200  # below this, a cost counts as zero

# --- assignments and their duals ------------------------------------------------------------------
#
# For any duals of the targets, the sum of the k smallest row minima of cost + dual, less the sum of all
# duals, is a lower bound on the cost of every one-to-one matching (weak duality). The duals of an optimal
# assignment attain its cost. Those of neighbours nearly do, so most parameters need no assignment.


class Profile(NamedTuple):
    """A lower bound on the objective at one parameter, as a sum over source points.

    It remains valid if each point has a gap: ``sum_of_smallest(rows - gaps) - total``.

    Attributes
    ----------
    rows : (r,) array
        Reduced row minima of the source points; only the sum of the smallest ones if all gaps are equal.
    total : float
        Sum of the duals.
    is_exact : bool
        Whether the bound is the objective itself.
    """

    rows: np.ndarray
    total: float
    is_exact: bool


def sum_of_smallest(values: np.ndarray, k: int) -> np.ndarray:
    """Return the sum of the k smallest values along the last axis."""
    if k == values.shape[-1]:
        return values.sum(axis=-1)
    return np.partition(values, k - 1, axis=-1)[..., :k].sum(axis=-1)


def cheapest_pairs(cost: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the k cheapest one-to-one pairs of (n, m) non-negative costs.

    Returns
    -------
    (n, m + n - k) array
        The costs, with n - k free columns for the unmatched rows.
    (n,) int array
        The column of each row in these costs.
    """
    from scipy.optimize import linear_sum_assignment  # not needed for rigid poses

    cost = _with_free_columns(cost, k)
    return cost, linear_sum_assignment(cost)[1]


def shortest_paths(cost: np.ndarray, k: int) -> tuple[float, np.ndarray]:
    """Return the sum of the k cheapest one-to-one pairs of (n, m) costs, and optimal duals, in NumPy.

    Rows are matched one after the other, each along a shortest augmenting path (Jonker and Volgenant,
    Computing 38, 1987, without their initialisation).

    Returns
    -------
    float
    (m,) array
    """
    m, cost = cost.shape[1], _with_free_columns(cost, k)
    duals, row_of = np.zeros(cost.shape[1]), np.full(cost.shape[1], -1)
    column_of = np.full(len(cost), -1)
    for row in range(len(cost)):
        length, before = cost[row] + duals, np.full(cost.shape[1], row)
        ahead, is_done = length.copy(), np.zeros(cost.shape[1], dtype=bool)
        column = int(ahead.argmin())
        while row_of[column] >= 0:
            is_done[column], ahead[column] = True, np.inf
            last = row_of[column]
            through = cost[last] + duals
            through += length[column] - through[column]
            shorter = (through < length) & ~is_done
            length[shorter] = ahead[shorter] = through[shorter]
            before[shorter] = last
            column = int(ahead.argmin())
        duals[is_done] += length[column] - length[is_done]
        while True:  # each row of the path takes the column that reaches it
            last = before[column]
            row_of[column] = last
            column, column_of[last] = column_of[last], column
            if last == row:
                break
    return float(cost[np.arange(len(cost)), column_of].sum()), duals[:m]


def improve_duals(
    costs: np.ndarray, duals: np.ndarray, k: int, enough: np.ndarray | float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return better duals for each of B poses, and the lower bounds that they prove.

    In each round of an auction, the price of a column decreases as far as no row minimum does, and then
    increases by the second-highest bid. A row bids the difference to its second-cheapest column.

    Parameters
    ----------
    costs : (B, n, m) array
    duals : (B, m) array
    k : int
        Number of one-to-one pairs.
    enough : float or (B,) array
        A bound that need not be improved.

    Returns
    -------
    (B,) array
        Lower bounds on the k cheapest pairs.
    (B, m) array
    """
    n, enough = costs.shape[1], np.broadcast_to(enough, len(costs))
    best, best_duals = np.full(len(costs), -np.inf), duals.astype(np.float64)
    left = np.arange(len(costs))  # poses whose bounds still increase
    for _ in range(ROUNDS):
        net = costs + duals[:, None]
        column = net.argmin(axis=2)
        low = np.take_along_axis(net, column[:, :, None], axis=2)[:, :, 0]
        ends = np.partition(low, (k - 1, min(k, n - 1)), axis=1)[:, [k - 1, min(k, n - 1)]]
        last, beyond = ends[:, :1], ends[:, 1:]
        lowered = duals - np.minimum(duals, (net - np.minimum(low, last)[:, :, None]).min(axis=1))
        values = sum_of_smallest(low, k) - lowered.sum(axis=1)
        rises = values > best[left]
        best[left[rises]], best_duals[left[rises]] = values[rises], lowered[rises]
        rises &= values < enough[left]
        left = left[rises]
        if not left.size:
            break
        np.put_along_axis(net, column[:, :, None], np.inf, axis=2)
        bids = net.min(axis=2) - low
        if k < n:  # a row that costs more is not matched
            bids = np.where(low <= last, np.minimum(bids, beyond - low), 0.0)
        duals = (lowered + _second_highest(bids, column, duals.shape[1]))[rises]
        if not rises.all():
            costs = costs[rises]
    return best, best_duals


def _second_highest(bids: np.ndarray, column: np.ndarray, m: int) -> np.ndarray:
    """Return the second-highest of the bids (B, n) for each of m columns; 0 if there is only one."""
    order = np.argsort(bids, axis=1)
    column, bids = (np.take_along_axis(each, order, axis=1) for each in (column, bids))
    pose = np.arange(len(bids))[:, None]
    # of several values for one place, NumPy keeps the last
    winner, price = np.full((len(bids), m), -1), np.zeros((len(bids), m))
    winner[pose, column] = order
    loses = order != winner[pose, column]
    price[np.nonzero(loses)[0], column[loses]] = bids[loses]
    return price


def _with_free_columns(cost: np.ndarray, k: int) -> np.ndarray:
    """Return (n, m) costs with n - k free columns, for the rows that remain unmatched."""
    return np.hstack([cost, np.zeros((len(cost), len(cost) - k))])


def duals_of(cost: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return optimal duals of the columns for an optimal assignment, as lengths of shortest paths."""
    potential = np.zeros(cost.shape[1])
    increase = cost - np.take_along_axis(cost, columns[:, None], axis=1)
    for _ in columns:  # a shortest path visits each row at most once
        lowered = np.minimum(potential, (increase + potential[columns, None]).min(axis=0))
        if (lowered == potential).all():
            break
        potential = lowered
    return -potential


class DualCache:
    """The duals at the parameters whose assignment was solved.

    Parameters
    ----------
    weights : (d,) array
        Scale of each axis, for distances between parameters.
    n_targets : int
    """

    def __init__(self, weights: np.ndarray, n_targets: int) -> None:
        self._weights = weights
        self._used = 0
        self._thetas, self._duals = np.empty((64, len(weights))), np.empty((64, n_targets))
        self._sizes = np.empty(64)  # |theta|^2

    def add(self, theta: np.ndarray, duals: np.ndarray) -> None:
        """Store the duals at `theta`."""
        if self._used == len(self._thetas):
            self._thetas = np.concatenate([self._thetas, np.empty_like(self._thetas)])
            self._duals = np.concatenate([self._duals, np.empty_like(self._duals)])
            self._sizes = np.concatenate([self._sizes, np.empty_like(self._sizes)])
        self._thetas[self._used] = theta = self._weights * theta
        self._sizes[self._used] = theta @ theta
        self._duals[self._used] = duals
        self._used += 1

    def near(self, theta: np.ndarray) -> np.ndarray:
        """Return the mean of the duals nearest to `theta`; zero if there are none."""
        if self._used <= NEIGHBOURS:
            return self._duals[: self._used].mean(axis=0) if self._used else np.zeros(1)
        # squared distances, up to a constant
        off = self._sizes[: self._used] - self._thetas[: self._used] @ (2.0 * self._weights * theta)
        return self._duals[np.argpartition(off, NEIGHBOURS)[:NEIGHBOURS]].mean(axis=0)


# --- pairs on a line ------------------------------------------------------------------------------
#
# The cheapest matching of two sorted lists by squared differences has no crossing pairs. It is a path
# through the grid of both lists: a step skips one number, or pairs one number of each list. For a given
# multiplier per pair, the cheapest path is found by dynamic programming. Its cost plus k multipliers is a
# lower bound on the cost of k pairs (Lagrangian duality), and exact if the path has k pairs.


class Line:
    """The k cheapest pairs of n varying numbers with m fixed, sorted ones, for many lists at once.

    Parameters
    ----------
    values : (m,) array
        In ascending order.
    n, k : int
    """

    def __init__(self, values: np.ndarray, n: int, k: int) -> None:
        self.n, self.m, self.k = n, len(values), k
        # on a path with k pairs, which skips n - k and m - k numbers, j - i stays between these
        low, high = k - n, self.m - k
        self._margin = high - low  # at least 1
        self._values = np.pad(values, self._margin)
        self._minimum, self._maximum = values[0], values[-1]
        # for even and for odd i + j: the smallest j - i, and the number of positions
        self._first = low + (low % 2), low + (low + 1) % 2
        self._width = tuple((high - first) // 2 + 1 for first in self._first)
        self._multiplier = 0.0  # the typical optimal one of the last lists

    def bounds(self, near: np.ndarray, far: np.ndarray, needed: float) -> np.ndarray:
        """Return lower bounds on the minimum sum of k squared distances of `values` to intervals.

        A bound is not improved further once it reaches `needed` or cannot reach it. Otherwise it is the
        minimum itself, rounded down.

        Parameters
        ----------
        near, far : (B, n) arrays
            Ends of the intervals of each list, both in ascending order.
        needed : float
            The bound that a box has to reach.
        """
        out = np.empty(len(near))
        size = max(1, MAX_CELLS // (self.n * (self._margin + 1)))
        for at in range(0, len(near), size):
            part = slice(at, at + size)
            out[part] = self._bounds(near[part].T, far[part].T, needed)
        return out

    def _bounds(self, near: np.ndarray, far: np.ndarray, needed: float) -> np.ndarray:
        """Maximise the dual function of (n, B) intervals over the multiplier of a pair.

        The dual function is concave with slope k minus the number of pairs on the cheapest path. The next
        multiplier is where the tangents on both sides of the maximum meet.
        """
        farthest = max(far.max() - self._minimum, self._maximum - near.min(), 0.0)
        top = max(min(needed, farthest**2), TINY)
        # Costs are integers, rounded down, minus one `label` per pair. Sums are then exact, and the
        # fractional part of a path's cost is its number of pairs.
        label = 0.5 ** min(self.n, self.m).bit_length()
        unit = top * self.n / label / 2.0**52
        costs = self._costs(near, far, unit, top)
        hopeless = needed if needed < np.inf else -np.inf
        count = near.shape[1]
        best, optimal, left = np.zeros(count), np.empty(count), np.arange(count)
        applied = np.full(count, -label)
        start = min(self._multiplier or 2.0 * top / self.k, top)
        multiplier = np.full(
            count, max(1.0, start // unit)
        )  # at least one unit, so that it can be doubled
        # multiplier, value and slope on either side of the maximum; a path without pairs costs zero
        rising = np.zeros((3, count))
        rising[2] = self.k
        falling = np.full((3, count), np.nan)
        while left.size:
            for cost in costs:
                cost -= multiplier - applied
            path = self._cheapest_path(costs)
            value = np.ceil(path)
            slope = self.k - (value - path) / label
            tangent = np.array([multiplier, value + self.k * multiplier, slope])
            best[left], optimal[left] = np.maximum(best[left], tangent[1]), multiplier
            rising = np.where(slope > 0, tangent, rising)
            falling = np.where(slope < 0, tangent, falling)
            new, reach = _meeting(rising, falling)
            new = np.minimum(np.where(np.isnan(new), 2.0 * multiplier, np.rint(new)), top // unit)
            continues = (
                (slope != 0) & (best[left] * unit < needed) & ~(reach * unit < hopeless)
                & (new > rising[0]) & ~(new >= falling[0])
            )  # fmt: skip
            left, applied, multiplier = left[continues], multiplier[continues], new[continues]
            if not continues.all():
                rising, falling = rising[:, continues], falling[:, continues]
                costs = [cost[..., continues] for cost in costs]
        self._multiplier = float(np.median(optimal)) * unit
        return best * unit

    def _costs(
        self, near: np.ndarray, far: np.ndarray, unit: float, top: float
    ) -> list[np.ndarray]:
        """Return the costs, as integers up to `top`, of the step to (i, j) that pairs two numbers.

        There are two (levels, width, B) arrays, for even and odd i + j. A level has the positions of one
        sum i + j >= 1 in ascending order of j - i. Positions outside of the grid have an arbitrary cost,
        since no path to the end of the grid visits them.
        """
        pad = ((self._margin, self._margin), (0, 0))
        scale = unit**-0.5
        near, far = np.pad(scale * near, pad), np.pad(scale * far, pad)
        numbers = scale * self._values
        costs = []
        for parity, first, width in zip((0, 1), self._first, self._width, strict=True):
            n_levels, level = (self.n + self.m + parity) // 2, 2 - parity
            i = self._margin + (level - first) // 2 - width  # the smallest one of the first level
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
        """Return the (B,) costs of the cheapest paths from (0, 0) to (n, m)."""
        # the last level of either parity, padded with unreachable positions
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
    """Return where two tangents (position, value, slope) meet, and their value there."""
    (at, low, rise), (end, high, fall) = rising, falling
    place = (high - low + rise * at - fall * end) / (rise - fall)
    return place, low + rise * (place - at)
