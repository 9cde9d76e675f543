"""Pairs matched at one pose, tried for fewer pairs at another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcreg.assignment.polish import objective
from dcreg.jit import NEVER
from dcreg.problem.geometry import apply_pose


@dataclass(frozen=True)
class Matched:
    """One-to-one pairs, and the pose they were matched at.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
    pairs : (K, 2) int array
    greedy : bool
        Whether near pairs were taken one after another, the nearest first.
    """

    T_target_source: np.ndarray
    pairs: np.ndarray
    greedy: bool = False

    def cheapest(
        self, source: np.ndarray, target: np.ndarray, T: np.ndarray, k: int
    ) -> tuple[float, np.ndarray]:
        """The k of the pairs that cost least at the pose `T`, and the sum of their squared residuals."""
        moved = apply_pose(T, source[self.pairs[:, 0]])
        moved -= target[self.pairs[:, 1]]
        costs = np.einsum("ij,ij->i", moved, moved)
        kept = np.sort(np.argpartition(costs, k - 1)[:k])
        return float(costs[kept].sum()), self.pairs[kept]


def quick_objective(
    source: np.ndarray,
    target: np.ndarray,
    T_target_source: np.ndarray,
    n_inliers: int,
    candidates: np.ndarray | None = None,
    *,
    known: Matched | None,
    prove: bool = True,
    stop: np.ndarray = NEVER,
) -> tuple[float, np.ndarray]:
    """`objective`, but that once `stop` is set the better of its pairs and of known ones is taken.

    Parameters
    ----------
    source, target, T_target_source, n_inliers, candidates, prove, stop
        As in `objective`.
    known : Matched, optional
        Feasible pairs, at least `n_inliers`.

    Returns
    -------
    value, assignment
        As in `objective`: the true value of these pairs, which bounds the least one from above.
    """

    def own() -> tuple[float, np.ndarray]:
        return objective(
            source, target, T_target_source, n_inliers, candidates, prove=prove, stop=stop
        )

    if known is None or not stop[0]:
        return own()
    given = known.cheapest(source, target, T_target_source, n_inliers)
    if known.greedy and np.array_equal(known.T_target_source, T_target_source):
        return given  # the k nearest pairs come first, however many follow
    return min(own(), given, key=lambda matched: matched[0])
