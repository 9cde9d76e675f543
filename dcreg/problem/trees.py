"""Search trees of point clouds.

pykdtree loads in a millisecond, `scipy.spatial` in a fifth of a second.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree

_KEPT = 2  # trees, of the clouds asked for last: about 50 bytes a point
_recent: tuple[Tree, ...] = ()
_is_forked = False


class Tree:
    """Nearest points of a cloud.

    Parameters
    ----------
    points : (n, d) array
        Finite; the tree has its own copy.
    """

    def __init__(self, points: np.ndarray) -> None:
        self.points = np.array(points, dtype=float, order="C")
        self.n = len(self.points)
        self._tree = KDTree(self.points)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the (q,) distances of the nearest points to q points, and their rows."""
        return self._query(points, 1)

    def neighbours(
        self, points: np.ndarray, count: int, *, reach: float | None = None, slack: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the (q, count) distances of the nearest points to q points, ascending, and their rows.

        Parameters
        ----------
        points : (q, d) array
        count : int
            At most `n`.
        reach : float, optional
            Where fewer points are nearer than this, infinite distances and the row `n` follow.
        slack : float
            Points may be farther than the nearest ones by this share.
        """
        found = self._query(points, count, eps=slack, distance_upper_bound=reach)
        distances, rows = (each.reshape(len(points), count) for each in found)
        return distances, rows

    def _query(
        self, points: np.ndarray, count: int, **options: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        points = np.ascontiguousarray(points, dtype=float)
        # in a forked process OpenMP waits forever for the threads of the parent; a new thread has its own
        if _is_forked:
            with ThreadPoolExecutor(1) as pool:
                distances, rows = pool.submit(self._tree.query, points, count, **options).result()
        else:
            distances, rows = self._tree.query(points, count, **options)
        return distances, rows.astype(np.int64)


def _forked() -> None:
    global _is_forked
    _is_forked = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


def tree_of(points: np.ndarray) -> Tree:
    """Return the search tree of a cloud that several stages look up; it is built once.

    Parameters
    ----------
    points : (n, d) array
        May change afterwards: clouds are compared by content.
    """
    global _recent
    found = next((tree for tree in _recent if np.array_equal(tree.points, points)), None)
    found = found or Tree(points)
    _recent = (found, *(tree for tree in _recent if tree is not found))[:_KEPT]
    return found
