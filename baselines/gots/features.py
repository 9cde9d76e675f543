"""Rotation-invariant features of point pairs, and the number that a translation can match.

For a translation t followed by any rotation about the origin, a source pair (i, k) has the features
``(|x_i + t|, |x_k + t|, |x_i - x_k|)`` and an ordered target pair (j, l) has ``(|y_j|, |y_l|,
|y_j - y_l|)``. If some rotation moves both points within eps of their partners, the features differ by at
most eps, eps and 2 eps. This is a weighted infinity norm, so a match is a target feature in a box.

For a cube of translations, the box of a source pair is the interval of each norm over the cube,
extended by eps. The number of pairs whose box contains a target feature bounds the matches of any t in
the cube.
"""

from __future__ import annotations

import numpy as np

_LEAF = 8  # target features per leaf of the tree


class FeatureTree:
    """Balanced tree of bounding boxes over the features of all ordered target pairs."""

    def __init__(self, target: np.ndarray) -> None:
        norms = np.linalg.norm(target, axis=1)
        first, second = np.nonzero(~np.eye(len(target), dtype=bool))
        lengths = np.linalg.norm(target[first] - target[second], axis=1)
        features = np.column_stack([norms[first], norms[second], lengths])
        # A child has at most half of its parent's features, rounded up.
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
        """Return the arrays for the kernels."""
        return self.features, self.spans, self.boxes, self.norms
