"""Shared parts of all bounding functions: the admissible set, threads, work counting."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from dcreg.search import Bound, Box, Evaluation
from dcreg.search.threads import Workers
from dcreg.spaces import Space

S = TypeVar("S", bound=Space)


class SpaceBound(abc.ABC, Generic[S]):
    """A bounding function over the boxes that bisection makes of some roots.

    Subclasses bound one slice of boxes in `_evaluate`; here boxes without an admissible parameter
    get +inf, inadmissible candidates lose their value, and slices run in parallel threads. Slices are
    independent, so the outcome is the same for any number of threads.

    Parameters
    ----------
    space : Space
    roots : sequence of Box, optional
        Default: those of the space.
    threads : int

    Attributes
    ----------
    n_assignments : int
        Exact assignments solved so far.
    round_pairs, max_round : int
        Pairs that a round of boxes may cost, and boxes at most: enough to keep threads busy, few
        enough for a search to stay interruptible.
    """

    round_pairs, max_round = 8_000_000, 256

    def __init__(self, space: S, roots: Sequence[Box] | None = None, threads: int = 1) -> None:
        self.space = space
        self.roots = list(roots) if roots is not None else space.roots()
        self.n_assignments = 0
        self._workers = Workers(threads)

    @property
    def round_size(self) -> int:
        return int(np.clip(self.round_pairs // self.space.n_pairs, 1, self.max_round))

    @abc.abstractmethod
    def _evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, thorough: bool
    ) -> Evaluation: ...

    def evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, *, thorough: bool = False
    ) -> Evaluation:
        """Bound B boxes; see `dcreg.search.Bound`."""
        if thorough:  # bounds stop early for the cutoff's sake alone
            cutoff = np.inf
        touched = np.flatnonzero(self.space.touches(lower, upper))
        found = self._evaluate(lower[touched], upper[touched], cutoff, thorough)
        bounds = np.full(len(lower), np.inf)
        thetas = 0.5 * (lower + upper)
        values = np.full(len(lower), np.inf)
        bounds[touched], thetas[touched] = found.lower_bounds, found.thetas
        values[touched] = np.where(self.space.admissible(found.thetas), found.values, np.inf)
        return Evaluation(bounds, thetas, values)

    def _run(self, work: Callable[[slice], int], count: int) -> None:
        """Apply `work` to slices that cover `count` items; it returns assignments spent."""
        self.space.check()  # already, or meanwhile
        self.n_assignments += self._workers.run(work, count)
        self.space.check()


class Strongest:
    """The greatest of several bounds over the same roots, box by box; all their candidates compete."""

    def __init__(self, parts: Sequence[SpaceBound[Any]]) -> None:
        self.parts = parts

    @property
    def roots(self) -> list[Box]:
        return self.parts[0].roots

    @property
    def round_size(self) -> int:
        return min(part.round_size for part in self.parts)

    @property
    def n_assignments(self) -> int:
        return sum(part.n_assignments for part in self.parts)

    def evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, *, thorough: bool = False
    ) -> Evaluation:
        """Bound B boxes; see `dcreg.search.Bound`."""
        best = self.parts[0].evaluate(lower, upper, cutoff, thorough=thorough)
        for part in self.parts[1:]:
            other = part.evaluate(lower, upper, cutoff, thorough=thorough)
            best.lower_bounds = np.maximum(best.lower_bounds, other.lower_bounds)
            better = other.values < best.values
            best.thetas[better], best.values[better] = other.thetas[better], other.values[better]
        best.hints = None  # they would be those of one part
        return best


# (space, roots, threads) -> bound
MakeBound = Callable[..., Bound]
