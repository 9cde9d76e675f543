"""Shared parts of all bounding functions: the admissible set, threads, work counting."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from dcreg.jit import NEVER
from dcreg.search import Bound, Box, Budget, Evaluation, Interrupted
from dcreg.search.budget import Workers


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
    stop_flag : (1,) uint8 array
        Kernels return at once when it is set, and `check` then raises; see `Budget.stop`.
    ends : sequence of (theta, value)
        Where the descents of the last `start` ended.
    """

    n_inliers: int
    axis_weights: np.ndarray
    scope: str
    n_descents: int
    stop_flag: np.ndarray = NEVER
    ends: Sequence[tuple[np.ndarray, float]] = ()

    def check(self, stop_flag: np.ndarray | None = None) -> None:
        """Raise after a kernel if the flag is set: the kernel's output is then incomplete.

        Parameters
        ----------
        stop_flag : (1,) uint8 array, optional
            Default: that of the space.

        Raises
        ------
        Interrupted
        """
        if (self.stop_flag if stop_flag is None else stop_flag)[0]:
            raise Interrupted

    @abc.abstractmethod
    def roots(self) -> list[Box]:
        """Boxes that together hold every global minimiser."""

    @abc.abstractmethod
    def objective(
        self, theta: np.ndarray, stop_flag: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """Return E(theta) and the column matched to every source row (-1: none).

        `stop_flag` replaces that of the space for this call.
        """

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
                    budget.report_incumbent(value)
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


_MAX_ROUNDS = 100


def alternate(
    theta: np.ndarray,
    value: float,
    col_of: np.ndarray,
    fit: Callable[[np.ndarray, np.ndarray], np.ndarray],
    evaluate: Callable[[np.ndarray], tuple[float, np.ndarray]],
    least_gain: float,
) -> tuple[np.ndarray, float, int]:
    """Fit the matched pairs and match anew, until the objective no longer falls.

    Parameters
    ----------
    theta : (dim,) array
    value : float
        The objective at `theta`; infinite where `theta` need not be admissible.
    col_of : (n,) int array
        The matching there.
    fit : callable
        From a parameter and a matching to the best parameter for the matching.
    evaluate : callable
        The objective at a parameter, and its matching.
    least_gain : float
        Share of the objective by which a step has to lower it; less is rounding.

    Returns
    -------
    theta, value, n_assignments
    """
    spent = 0
    for _ in range(_MAX_ROUNDS):
        trial = fit(theta, col_of)
        trial_value, trial_col = evaluate(trial)
        spent += 1
        if trial_value >= value * (1.0 - least_gain):
            break
        theta, value, col_of = trial, trial_value, trial_col
    return theta, value, spent


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
