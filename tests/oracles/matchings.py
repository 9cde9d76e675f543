"""All matchings of a few points: the oracle of searches and of assignments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations, permutations

import numpy as np


def matchings(n: int, m: int, k: int) -> Iterator[tuple[list[int], list[int]]]:
    """Rows and columns of every matching of k pairs."""
    for rows in map(list, combinations(range(n), k)):
        for columns in map(list, permutations(range(m), k)):
            yield rows, columns


def cheapest_fit(
    source: np.ndarray,
    target: np.ndarray,
    k: int,
    moved: Callable[[np.ndarray, np.ndarray], np.ndarray],
    allowed: np.ndarray | None = None,
) -> float:
    """Minimum over the matchings of k allowed pairs; `moved(x, y)` are the points x fitted to y."""
    return min(
        float(((moved(source[rows], target[columns]) - target[columns]) ** 2).sum())
        for rows, columns in matchings(len(source), len(target), k)
        if allowed is None or allowed[rows, columns].all()
    )
