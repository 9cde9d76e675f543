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


def every_matching(n: int, m: int, k: int) -> np.ndarray:
    """Rows and columns of every matching, as a (2, count, k) array."""
    return np.array(list(matchings(n, m, k))).swapaxes(0, 1)


def rotation_residuals(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sums of squared residuals of (b, k, 3) paired points, each at its best rotation."""
    spread = y.transpose(0, 2, 1) @ x
    singular = np.linalg.svd(spread, compute_uv=False)
    singular[:, 2] *= np.where(np.linalg.det(spread) < 0, -1.0, 1.0)
    return (x**2).sum(axis=(1, 2)) + (y**2).sum(axis=(1, 2)) - 2 * singular.sum(axis=1)


def optimal_rotation(source: np.ndarray, target: np.ndarray, k: int) -> float:
    """Minimum over all matchings, each with its best rotation about the origin."""
    rows, columns = every_matching(len(source), len(target), k)
    return float(rotation_residuals(source[rows], target[columns]).min())


def optimal_similarity(
    source: np.ndarray, target: np.ndarray, k: int, scale_range: tuple[float, float]
) -> float:
    """Minimum over all matchings in 2D, each with its closed-form pose of clipped scale."""
    rows, columns = every_matching(len(source), len(target), k)
    x, y = (source @ [1, 1j])[rows], (target @ [1, 1j])[columns]
    x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
    spread, product = (np.abs(x) ** 2).sum(axis=1), np.abs((x.conj() * y).sum(axis=1))
    scale = np.clip(product / np.maximum(spread, 1e-300), *scale_range)
    return float(((np.abs(y) ** 2).sum(axis=1) - 2 * scale * product + scale**2 * spread).min())
