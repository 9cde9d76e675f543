"""Shared parts of all bounding functions: the admissible set, threads, work counting."""

from __future__ import annotations

import abc
from collections.abc import Callable

import numpy as np

from dcreg.models import Model
from dcreg.search import Evaluation
from dcreg.threads import Workers


class ModelBound(abc.ABC):
    """A bounding function over the boxes of a model.

    Subclasses bound one slice of boxes in `_evaluate`; here boxes without an admissible parameter
    get +inf, inadmissible candidates lose their value, and slices run in parallel threads. Slices are
    independent, so the outcome is the same for any number of threads.
    """

    def __init__(self, model: Model, threads: int = 1) -> None:
        self.model = model
        self.n_assignments = 0
        self._workers = Workers(threads)

    @abc.abstractmethod
    def _evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation: ...

    def evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        touched = np.flatnonzero(self.model.touches(lower, upper))
        found = self._evaluate(lower[touched], upper[touched], cutoff)
        bounds = np.full(len(lower), np.inf)
        thetas = 0.5 * (lower + upper)
        values = np.full(len(lower), np.inf)
        bounds[touched], thetas[touched] = found.lower_bounds, found.thetas
        values[touched] = np.where(self.model.admissible(found.thetas), found.values, np.inf)
        return Evaluation(bounds, thetas, values)

    def _run(self, work: Callable[[slice], int], count: int) -> None:
        """Apply `work` to slices that cover `count` items; it returns assignments spent."""
        self.n_assignments += self._workers.run(work, count)


class Strongest:
    """The greatest of several bounds, box by box; all their candidates compete."""

    def __init__(self, parts: list[ModelBound]) -> None:
        self.parts = parts

    @property
    def n_assignments(self) -> int:
        return sum(part.n_assignments for part in self.parts)

    def evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        best = self.parts[0].evaluate(lower, upper, cutoff)
        for part in self.parts[1:]:
            other = part.evaluate(lower, upper, cutoff)
            best.lower_bounds = np.maximum(best.lower_bounds, other.lower_bounds)
            better = other.values < best.values
            best.thetas[better], best.values[better] = other.thetas[better], other.values[better]
        return best
