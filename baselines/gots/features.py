"""Rotation-invariant features of point pairs, and how many of them a translation can match.

For a translation t followed by any rotation about the origin, a source pair (i, k) has the features
``(|x_i + t|, |x_k + t|, |x_i - x_k|)`` and an ordered target pair (j, l) has ``(|y_j|, |y_l|,
|y_j - y_l|)``. If some rotation brings both points within eps of their partners, the features differ
by at most eps, eps and 2 eps: a weighted infinity norm, so a match is a target feature in a box.

The box of a source pair for a whole cube of translations is the cube's interval of each norm, grown
by eps; the pairs whose box holds a target feature are at least as many as any t of the cube matches.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_LEAF = 8  # target features per leaf of the tree


class FeatureTree:
    """Balanced tree of bounding boxes over the features of all ordered target pairs."""

    def __init__(self, target: np.ndarray) -> None:
        norms = np.linalg.norm(target, axis=1)
        first, second = np.nonzero(~np.eye(len(target), dtype=bool))
        lengths = np.linalg.norm(target[first] - target[second], axis=1)
        features = np.column_stack([norms[first], norms[second], lengths])
        # A child holds at most half of its parent's features, rounded up.
        self.levels = max(0, int(np.ceil(np.log2(max(len(features), 1) / _LEAF))))
        n_nodes = 2 ** (self.levels + 1) - 1
        self.spans = np.zeros((n_nodes, 2), np.int64)
        self.boxes = np.empty((n_nodes, 6))
        self.boxes[:, :3], self.boxes[:, 3:] = np.inf, -np.inf
        order = np.arange(len(features))
        self._split(features, order, 0, 0, len(features))
        self.features = np.ascontiguousarray(features[order])
        self.norms = np.sort(norms)

    def _split(
        self, features: np.ndarray, order: np.ndarray, node: int, start: int, stop: int
    ) -> None:
        self.spans[node] = start, stop
        if start == stop:
            return
        own = features[order[start:stop]]
        low, high = own.min(axis=0), own.max(axis=0)
        self.boxes[node, :3], self.boxes[node, 3:] = low, high
        if 2 * node + 2 < len(self.spans):
            middle = (stop - start) // 2
            ranks = np.argpartition(own[:, (high - low).argmax()], middle)
            order[start:stop] = order[start:stop][ranks]
            self._split(features, order, 2 * node + 1, start, start + middle)
            self._split(features, order, 2 * node + 2, start + middle, stop)

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """What the kernels take."""
        return self.features, self.spans, self.boxes, self.norms


@njit(cache=True)
def matched_pairs(source, pairs, listed, centre, half, eps, bar, features, spans, boxes, norms):
    """Those of the listed source pairs that some t of the cube may match; None too few for `bar`.

    Returns (pairs kept, bound on their number). The bound is valid also when the count was given
    up because it cannot exceed `bar`. With ``half = 0`` it is the exact count at the centre.
    """
    n = len(source)
    low, high = np.empty(n), np.empty(n)
    alone = np.empty(n, np.bool_)
    for i in range(n):
        low[i], high[i] = _norm_interval(source[i], centre, half)
        low[i] -= eps
        high[i] += eps
        # A point without any target norm in reach spoils all its pairs.
        place = np.searchsorted(norms, low[i])
        alone[i] = place == len(norms) or norms[place] > high[i]
    kept = np.empty(len(listed), np.int32)
    n_kept = 0
    for position in range(len(listed)):
        p = listed[position]
        i, k = int(pairs[p, 0]), int(pairs[p, 1])
        if not (alone[i] or alone[k]) and _holds(
            low[i], high[i], low[k], high[k], pairs[p, 2] - 2 * eps, pairs[p, 2] + 2 * eps,
            features, spans, boxes,
        ):  # fmt: skip
            kept[n_kept] = p
            n_kept += 1
        most = n_kept + len(listed) - position - 1
        if most <= bar:
            return kept[:0], most
    return kept[:n_kept], n_kept


@njit(cache=True)
def _norm_interval(x, centre, half):
    """Least and largest |x + t| over the cube, widened by rounding."""
    least = largest = 0.0
    for axis in range(3):
        a = abs(x[axis] + centre[axis])
        least += max(a - half, 0.0) ** 2
        largest += (a + half) ** 2
    return np.sqrt(least) - 1e-12, np.sqrt(largest) + 1e-12


@njit(cache=True)
def _holds(low_a, high_a, low_b, high_b, low_c, high_c, features, spans, boxes):
    """Whether a target feature lies in the box."""
    stack = np.empty(64, np.int64)
    stack[0] = 0
    size = 1
    while size > 0:
        size -= 1
        node = stack[size]
        box = boxes[node]
        if (
            box[0] > high_a or box[3] < low_a or box[1] > high_b or box[4] < low_b
            or box[2] > high_c or box[5] < low_c
        ):  # fmt: skip
            continue
        if (
            box[0] >= low_a and box[3] <= high_a and box[1] >= low_b and box[4] <= high_b
            and box[2] >= low_c and box[5] <= high_c
        ):  # fmt: skip
            return True
        if 2 * node + 2 < len(boxes):
            stack[size], stack[size + 1] = 2 * node + 1, 2 * node + 2
            size += 2
            continue
        for f in range(spans[node, 0], spans[node, 1]):
            a, b, c = features[f, 0], features[f, 1], features[f, 2]
            if low_a <= a <= high_a and low_b <= b <= high_b and low_c <= c <= high_c:
                return True
    return False
