"""Search trees of point clouds. SciPy is loaded with the first one: small problems do without it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_KEPT = 2  # trees, of the clouds asked for last: about 50 bytes a point
_recent: tuple[cKDTree, ...] = ()


def tree_of(points: np.ndarray) -> cKDTree:
    """Return the search tree of a cloud that several stages look up; it is built once.

    Parameters
    ----------
    points : (n, d) array
        May change afterwards: the tree has its own copy, and clouds are compared by content.
    """
    global _recent
    found = next((tree for tree in _recent if np.array_equal(tree.data, points)), None)
    found = found or new_tree(points)
    _recent = (found, *(tree for tree in _recent if tree is not found))[:_KEPT]
    return found


def new_tree(points: np.ndarray) -> cKDTree:
    """Return the search tree of points that are looked up once.

    Many queries lie far outside the overlap. Cells that are halved in the middle answer them in half the
    time of cells of equally many points.
    """
    from scipy.spatial import cKDTree

    return cKDTree(points, balanced_tree=False, compact_nodes=False, copy_data=True)
