"""Whether boxes tile a box: no gap, no overlap, nothing outside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.certificate.format import CertificateError

# Coordinates closer than this share of the start box, or of smaller clouds, are the same.
SAME = 1e-12


def check_cover(
    start_lower: np.ndarray, start_upper: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> None:
    """Check that the leaves tile the start box.

    The box is cut between leaves, and its parts again, until each part is one leaf. Every tiling that
    bisection makes can be taken apart so. A part that no plane divides holds overlapping leaves; a part
    with one leaf that does not fill it has a gap.

    Parameters
    ----------
    start_lower, start_upper : (d,) arrays
        Corners of the start box, in units of the clouds.
    lower, upper : (L, d) arrays
        Corners of the leaves.

    Raises
    ------
    CertificateError
        Naming a leaf next to the gap or in the overlap.
    """
    if not (lower <= upper).all():
        raise CertificateError(f"leaf {np.argmin((lower <= upper).all(axis=1))} is not a box")
    grid = _Grid.of(start_lower, start_upper, lower, upper)
    wide = np.flatnonzero(grid.first < grid.last)  # a plane across a flat axis would divide nothing
    parts = [(grid.first, grid.last, np.arange(len(lower)))]
    while parts:
        first, last, leaves = parts.pop()
        if len(leaves) == 1:
            leaf = leaves[0]
            if (grid.low[leaf] != first).any() or (grid.high[leaf] != last).any():
                raise CertificateError(
                    f"leaves: a gap, or a part outside of the start box, next to leaf {leaf}"
                )
            continue
        axis, cut, left, right = _cut(grid, leaves, wide)
        middle_last, middle_first = last.copy(), first.copy()
        middle_last[axis] = middle_first[axis] = cut
        parts += [(first, middle_last, left), (middle_first, last, right)]


class _Grid(NamedTuple):
    """Coordinates as ranks among the distinct ones of their axis, so that rounding does not matter.

    Attributes
    ----------
    low, high : (L, d) int arrays
        Corners of the leaves.
    first, last : (d,) int arrays
        Corners of the start box.
    places : list of d arrays
        The coordinate that each rank stands for.
    """

    low: np.ndarray
    high: np.ndarray
    first: np.ndarray
    last: np.ndarray
    places: list[np.ndarray]

    @classmethod
    def of(
        cls, start_lower: np.ndarray, start_upper: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> _Grid:
        low, high = np.empty(lower.shape, np.int64), np.empty(lower.shape, np.int64)
        first, last = np.empty(len(start_lower), np.int64), np.empty(len(start_lower), np.int64)
        places = []
        for axis in range(len(start_lower)):
            ends = np.array([start_lower[axis], start_upper[axis]])
            values = np.unique(np.concatenate([lower[:, axis], upper[:, axis], ends]))
            tolerance = SAME * (min(ends[1] - ends[0], 1.0) or max(1.0, abs(ends[0])))
            rank = np.concatenate([[0], np.cumsum(np.diff(values) > tolerance)])
            low[:, axis] = rank[np.searchsorted(values, lower[:, axis])]
            high[:, axis] = rank[np.searchsorted(values, upper[:, axis])]
            first[axis], last[axis] = rank[np.searchsorted(values, ends)]
            places.append(values[np.concatenate([[True], np.diff(rank) > 0])])
        return cls(low, high, first, last, places)


def _cut(
    grid: _Grid, leaves: np.ndarray, axes: np.ndarray
) -> tuple[int, int, np.ndarray, np.ndarray]:
    """A plane that crosses none of `leaves`: its axis and rank, and the leaves on either side.

    Of all such planes the one nearest to the middle of its axis, as bisection would have put it.
    """
    best: tuple | None = None
    for axis in axes:
        low, high, places = grid.low[:, axis], grid.high[:, axis], grid.places[axis]
        order = leaves[np.argsort(low[leaves], kind="stable")]
        reach = np.maximum.accumulate(high[order])
        free = np.flatnonzero(low[order[1:]] >= reach[:-1])
        if not free.size:
            continue
        begin, end = places[low[order[0]]], places[reach[-1]]
        off = np.abs(places[reach[free]] - 0.5 * (begin + end)) / (end - begin or 1.0)
        at = int(np.argmin(off))
        if best is None or off[at] < best[0]:
            split = free[at] + 1
            best = (off[at], axis, reach[free[at]], order[:split], order[split:])
        if best[0] == 0.0:
            break
    if best is None:
        raise CertificateError(f"leaves: {leaves[0]} and {leaves[1]} or others near them overlap")
    return best[1:]
