"""GoTS: branch and bound over translations for the most matched pair features.

Objective values are minus the number of matched source pairs at a translation. c source points that are
matched one to one at a pose give c (c - 1) / 2 matched pairs.
"""

from __future__ import annotations

import numpy as np

from baselines._shared.cubes import Incumbent, OutOfTimeError
from baselines.gots.features import FeatureTree
from baselines.gots.kernels import matched_pairs
from dcreg.search import Budget


class TranslationCubes:
    """The bound of a cube of translations; it passes the list of possible pairs on to the octants."""

    def __init__(
        self, source: np.ndarray, target: np.ndarray, eps: float, incumbent: Incumbent,
        budget: Budget,
    ) -> None:  # fmt: skip
        self.source, self.eps = np.ascontiguousarray(source), eps
        self.incumbent, self.budget = incumbent, budget
        first, second = np.triu_indices(len(source), 1)
        lengths = np.linalg.norm(source[first] - source[second], axis=1)
        # Long pairs are rare and fail first, so that a cube is discarded sooner.
        order = np.argsort(-lengths, kind="stable")
        self.pairs = np.column_stack([first, second, lengths])[order]
        self.all_pairs = np.arange(len(self.pairs), dtype=np.int32)
        self.tree = FeatureTree(target)

    def count(self, translation: np.ndarray) -> int:
        """Count the source pairs with a matching target pair at the translation."""
        return self._matched(self.all_pairs, translation, 0.0, -1)[1]

    def bound(
        self, centre: np.ndarray, half: float, possible: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """Return minus the maximum number of pairs in the cube; improve the incumbent."""
        if self.budget.is_over:
            raise OutOfTimeError
        known = int(-self.incumbent.value)
        kept, upper = self._matched(possible, centre, half, known)
        if upper > known:
            _, count = self._matched(kept, centre, 0.0, known)
            if count > known:
                self.incumbent.offer(-count, centre)
        return -float(upper), kept

    def _matched(
        self, listed: np.ndarray, centre: np.ndarray, half: float, bar: int
    ) -> tuple[np.ndarray, int]:
        return matched_pairs(
            self.source, self.pairs, listed, centre, half, self.eps, bar, *self.tree.arrays
        )


def points_of(n_pairs: float) -> float:
    """Return the number c of points with c (c - 1) / 2 = `n_pairs` pairs."""
    return (1.0 + np.sqrt(1.0 + 8.0 * n_pairs)) / 2.0


def matching_translations(
    source: np.ndarray, target: np.ndarray, eps: float
) -> tuple[np.ndarray, float]:
    """Return centre and half-width of a cube with every t such that some x + t has the norm of some y."""
    low, high = source.min(axis=0), source.max(axis=0)
    half = (high - low).max() / 2 + np.linalg.norm(target, axis=1).max() + eps
    return -(low + high) / 2, float(half) * (1 + 1e-9)
