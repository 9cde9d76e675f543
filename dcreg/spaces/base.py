"""What every parameter space offers to bounds and search."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence

import numpy as np

from dcreg.kernels.points import NEVER
from dcreg.search import Box, Budget, Interrupted


class Space(abc.ABC):
    """A parameterised family of poses over a normalised problem.

    Attributes
    ----------
    n_inliers : int
    axis_weights : (dim,) array
        RMS motion of the source per unit step along each axis.
    scope : str
        What a certificate over this space speaks of.
    n_descents : int
        Descents made for the first incumbent: enough for a good upper bound, cheap beside any search.
    stop : (1,) uint8 array
        Once it is set, kernels return at once and `check` raises; see `heed`.
    ends : sequence of (theta, value)
        Where the descents of the last `start` ended.
    """

    n_inliers: int
    axis_weights: np.ndarray
    scope: str
    n_descents: int
    stop: np.ndarray = NEVER
    ends: Sequence[tuple[np.ndarray, float]] = ()

    def heed(self, stop: np.ndarray) -> None:
        """From now on look at `stop`, as of `Budget.stop`, within everything that takes long."""
        self.stop = stop

    def check(self) -> None:
        """To be called after kernels: what they return is of no use if they were told to stop.

        Raises
        ------
        Interrupted
        """
        if self.stop[0]:
            raise Interrupted

    @abc.abstractmethod
    def roots(self) -> list[Box]:
        """Boxes that together hold every global minimiser."""

    @abc.abstractmethod
    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """E(theta) and the column matched to every source row (-1: none)."""

    @abc.abstractmethod
    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Alternate matching and closed-form fit from `theta`: admissible theta, objective, work."""

    @abc.abstractmethod
    def seeds(self) -> np.ndarray:
        """(S, dim) parameters spread over the family, to start descents from."""

    @abc.abstractmethod
    def score(self, seeds: np.ndarray) -> tuple[np.ndarray, int]:
        """How promising each seed is, the least first, and the assignments that took."""

    @property
    def n_pairs(self) -> int:
        """Pairs that one look at the objective has to price."""
        return self.n_source * self.n_target

    @property
    @abc.abstractmethod
    def n_source(self) -> int: ...

    @property
    @abc.abstractmethod
    def n_target(self) -> int: ...

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        """Which of (B, dim) parameters are poses of the family."""
        return np.ones(len(thetas), dtype=bool)

    def touches(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Which of B boxes may hold an admissible parameter (False only when surely none)."""
        return np.ones(len(lower), dtype=bool)

    def starts(self, budget: Budget) -> Iterator[tuple[np.ndarray, int]]:
        """Parameters to descend from, the most promising first, each with the assignments it took."""
        self.check()
        seeds = self.seeds()
        scores, spent = self.score(seeds)
        self.check()
        for seed in seeds[np.argsort(scores, kind="stable")[: self.n_descents]]:
            yield seed, spent
            spent = 0

    def start(self, budget: Budget, enough: float = 0.0) -> tuple[np.ndarray, float, int]:
        """The best of the descents from `starts`: theta, objective, work.

        At least one descent is begun, however short the time. The value is infinite where not even that
        one came to an end. With a value of at most `enough`, `n_descents` starts will do.
        """
        best: np.ndarray | None = None
        value, spent = np.inf, 0
        ends = self.ends = []
        try:
            for tried, (theta, choosing) in enumerate(self.starts(budget), start=1):
                spent += choosing
                if best is not None and budget.is_over:
                    break
                best = theta if best is None else best
                theta, found, descending = self.refine(theta)
                spent += descending
                ends.append((theta, found))
                if found < value:
                    best, value = theta, found
                    budget.found(value)
                if tried >= self.n_descents and value <= enough:  # before the next start is made
                    break
        except Interrupted:
            pass
        return self.seeds()[0] if best is None else best, value, spent


def means_of_subsets(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Per axis of (d, n) points, the least and the greatest mean of any `count` of them."""
    low = np.array([-mean_of_largest(-values, count) for values in points])
    high = np.array([mean_of_largest(values, count) for values in points])
    # where all are taken they are equal but for rounding, which may put them the wrong way round
    return np.minimum(low, high), np.maximum(low, high)


def mean_of_largest(values: np.ndarray, count: int) -> float:
    """Mean of the `count` largest numbers: the most a mean over `count` of them can be."""
    return float(np.sort(values)[-count:].mean())


def largest_subset_mean(points: np.ndarray, count: int, n_directions: int = 64) -> float:
    """An upper bound on ``|mean of any `count` points|`` in the plane.

    The support function of all subset means is the mean of the largest projections; sampled
    directions miss the worst one by at most half their spacing.
    """
    angles = np.arange(n_directions) * (2 * np.pi / n_directions)
    directions = np.stack([np.cos(angles), np.sin(angles)])
    projections = np.sort(points @ directions, axis=0)[-count:].mean(axis=0)
    return float(max(projections.max(), 0.0) / np.cos(np.pi / n_directions))


def radius(points: np.ndarray) -> float:
    """Greatest distance of any point from the origin."""
    return float(np.sqrt((points**2).sum(axis=1)).max())
